"""Signed runs: the same digest with any keys, and no signature on record that is not its origin's."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fleet.test_verify import PACES, as_exchange, troubled
from kantor_fleet.campaign.mission import attempt
from kantor_fleet.execution import in_process_team
from kantor_fleet.execution.experiment import Case, run_case
from kantor_fleet.execution.in_process_team import play, team_identities
from kantor_fleet.execution.verify import verify
from kantor_fleet.exits import Exit
from kantor_fleet.report.history import RunHistory
from kantor_protocol.base.machine import Envelope, ParticipantId
from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Attestation, Identities, without_signatures
from kantor_protocol.wire.messages import decode_gossip, encode_gossip
from kantor_protocol.wire.signing_keys import Ed25519Key
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.journal import Journal, file_digest, read
from kantor_worldsim.record.records import Batch, Record
from kantor_worldsim.record.run_folder import JOURNAL, MANIFEST, Past, ResumeError
from kantor_worldsim.world.world import WorldSetup
from support.missions import on_map, setup_of
from support.strategies import SMALL

SIGNED = 'trust="signed"'


def small(*overrides: str) -> Scenario:
    """A small mission in which participants sign."""
    roomy = ("samples.count=60", "energy.points=90", "energy.steps=60", "limit_s=6")
    return parse(SMALL, "small", (*roomy, SIGNED, *overrides))


def recorded(scenario: Scenario, folder: Path | None = None) -> Result:
    """Play a mission, into a run folder if there is one."""
    recording = Recording(scenario, 1, "in-process", folder)
    setup = setup_of(scenario) if scenario.mapping else WorldSetup.of(scenario, 1)
    play(scenario, 1, setup, [recording.observe])
    return recording.finish()


def records_in(folder: Path) -> list[Record]:
    """The records of a run folder."""
    return [record for _, record in read(folder / JOURNAL)]


def envelopes_in(records: list[Record]) -> Iterator[Envelope]:
    """All that participants sent, in order."""
    for record in records:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            yield from step_record.outputs.outbox if step_record.outputs else ()


def rewrite(folder: Path, records: list[Record]) -> None:
    """Write other records into a run folder, so that its manifest says that they are as they were written."""
    journal = Journal(folder / JOURNAL)
    for record in records:
        journal.append(record)
    journal.close()
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest |= {
        "journal_blake2b": file_digest(folder / JOURNAL),
        "digest": journal.digest.hex,
        "records": journal.digest.records,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest))


def with_body(records: list[Record], old: bytes, new: bytes) -> list[Record]:
    """The records with another body in place of one."""

    def changed(value: Any) -> Any:
        return (
            type(value)(map(changed, value)) if isinstance(value, list) else _put(value, old, new)
        )

    tree = [msgspec.to_builtins(record, builtin_types=(bytes,)) for record in records]
    return [msgspec.convert(changed(row), Record) for row in tree]


def _put(value: Any, old: bytes, new: bytes) -> Any:
    if isinstance(value, tuple):
        return tuple(_put(item, old, new) for item in value)
    if isinstance(value, list):
        return [_put(item, old, new) for item in value]
    if isinstance(value, dict):
        return {key: _put(item, old, new) for key, item in value.items()}
    return new if value == old else value


MISSIONS = {
    "ledger": small(),
    "min": small('merge="min"'),
    "claims": small("claims=true", "planner='transport'"),
    "supervised": small('coordination="centralized"'),
    "map": on_map(SIGNED),
    "hostile": small(
        "faults=[{kind='hostile', probability=0.8}]", "limit_s=12", "energy.steps=120"
    ),
    "replayed": small("faults=[{kind='replay', probability=0.8, age_s=1.0}]"),
}


@pytest.mark.parametrize("name", MISSIONS)
def test_the_digest_is_the_same_with_other_keys(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The records are not: every signature is another."""
    mission = MISSIONS[name]
    (tmp_path / "one").mkdir()
    one = recorded(mission, tmp_path / "one")

    def other(_seed: int, who: ParticipantId) -> Ed25519Key:
        return Ed25519Key(hashlib.blake2b(who.encode(), digest_size=32).digest())

    monkeypatch.setattr(in_process_team, "_key", other)
    (tmp_path / "two").mkdir()
    two = recorded(mission, tmp_path / "two")

    assert one.violations == two.violations == 0, one.complaints
    assert one.digest == two.digest
    bodies = [
        [envelope.body for envelope in envelopes_in(records_in(tmp_path / run))]
        for run in ("one", "two")
    ]
    assert bodies[0] != bodies[1]
    assert [*map(without_signatures, bodies[0])] == [*map(without_signatures, bodies[1])]


def test_in_one_process_signatures_are_deterministic(tmp_path: Path) -> None:
    """The same mission has the same records, byte for byte."""
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        recorded(small(), tmp_path / run)

    one, two = (list(read(tmp_path / run / JOURNAL)) for run in ("one", "two"))
    assert one == two
    assert one[1][1] == team_identities(small(), 1)


@pytest.mark.parametrize("exchange", ["in-process", "wall"])
@pytest.mark.parametrize("pace", PACES)
def test_a_signed_run_full_of_deaths_is_verified(
    pace: str, exchange: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Executed again or replayed: who starts again signs again, and world-sim goes on with the same identities."""
    scenario = troubled(*PACES[pace], SIGNED)
    result = recorded(scenario, tmp_path)
    as_exchange(tmp_path, exchange)
    code = verify(tmp_path)

    out = capsys.readouterr().out
    replayed = exchange == "wall"  # the checker expects of it what no mission in virtual time does
    assert replayed or (code, "FAIL" in out) == (Exit.DONE, False), out
    assert not replayed or f"steps of {len(scenario.roster)} participants, all the same" in out, out
    assert result.incarnations > 0
    assert "attestations, all signed by their origins" in out
    assert " 0 attestations" not in out
    assert sum(isinstance(record, Identities) for record in records_in(tmp_path)) == 1


def attested_in(records: list[Record]) -> Iterator[tuple[bytes, list[Attestation], bool]]:
    """Bodies with attestations, these, and whether one of them is of another origin."""
    for envelope in envelopes_in(records):
        attestations = list(decode_gossip(envelope.body).attestations)
        if attestations:
            yield envelope.body, attestations, attestations[0].origin != attestations[-1].origin


@pytest.mark.parametrize("at", [0, 63])
@pytest.mark.parametrize("forwarded", [False, True])
def test_one_bit_of_a_signature_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], at: int, *, forwarded: bool
) -> None:
    """The own one and one that was passed on, in a record that is otherwise whole."""
    recorded(troubled(SIGNED), tmp_path)
    records = records_in(tmp_path)
    body, attestations, _ = next(
        found for found in attested_in(records) if found[2] or not forwarded
    )
    place = 0 if forwarded else -1
    signature = bytearray(attestations[place].signature)
    signature[at] ^= 1
    attestations[place] = msgspec.structs.replace(attestations[place], signature=bytes(signature))
    message = msgspec.structs.replace(decode_gossip(body), attestations=tuple(attestations))
    rewrite(tmp_path, with_body(records, body, encode_gossip(message)))

    assert verify(tmp_path) is Exit.NOT_MET
    out = capsys.readouterr().out.splitlines()
    assert [line[:4] for line in out].count("FAIL") == 1, out
    assert any(line.startswith("FAIL  signatures: t=") for line in out), out
    assert any(line.startswith("ok    digest of ") for line in out), out


@pytest.mark.parametrize("where", ["nowhere", "at the end", "twice"])
def test_identities_follow_the_opening(
    where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Elsewhere they are found by verify and by the checker, and the digest does not change."""
    digest = recorded(small(), tmp_path).digest
    opening, identities, *rest = records_in(tmp_path)
    others = {
        "nowhere": [opening, *rest],
        "at the end": [opening, *rest[:-1], identities, rest[-1]],
        "twice": [opening, identities, identities, *rest],
    }
    rewrite(tmp_path, others[where])

    assert verify(tmp_path) is Exit.NOT_MET
    out = capsys.readouterr().out
    assert "FAIL  checker: 1 violations, first: order:" in out or where == "at the end", out
    assert f"ok    digest of {len(rest) + 1} records: {digest}" in out
    assert ("FAIL  signatures: the record does not say whose word counts" in out) == (
        where != "twice"
    )


def test_an_open_run_with_identities_is_no_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They belong to signed runs only."""
    scenario = small('trust="open"')
    recorded(scenario, tmp_path)
    opening, *rest = records_in(tmp_path)
    rewrite(tmp_path, [opening, Identities("run", {}), *rest])

    assert verify(tmp_path) is Exit.NOT_MET
    assert "order:" in capsys.readouterr().out


def test_a_signed_run_goes_on_with_its_identities(tmp_path: Path) -> None:
    """From any record on; with the opening alone it has not begun."""
    recorded(small(), tmp_path)
    records = records_in(tmp_path)
    rewrite(tmp_path, records[:9])
    past = Past.of(tmp_path)

    assert past.identities == records[1] == team_identities(small(), 1)
    assert past.records == tuple(records[:9])
    again: list[Record] = []
    setup = past.opening.setup
    simulation = Simulation.resumed(small(), 1, setup, past.records, [again.append])
    assert simulation.now_ns == records[8].now_ns  # type: ignore[union-attr]

    rewrite(tmp_path, records[:1])
    with pytest.raises(ResumeError, match="nothing has happened"):
        Past.of(tmp_path)


def test_readers_of_records_skip_identities(tmp_path: Path) -> None:
    """Report, campaign and sweep."""
    result = recorded(small(), tmp_path)
    history = RunHistory.of(records_in(tmp_path))
    trial = attempt(Case(small(), 100))  # executed twice, cut, and merged in another order
    outcome = run_case(Case(small(), 1))

    assert history is not None
    assert history.end_ns > 0
    assert (trial.violation, trial.twice, trial.cut) == (None, 1, 3)
    assert outcome.result is not None, outcome.failed
    assert outcome.result.digest == result.digest


def test_trust_is_a_key_like_any_other() -> None:
    """Written when it was given, and read again."""
    assert "trust" not in to_toml(parse(SMALL, "small"))
    for trust in ("open", "signed"):
        scenario = parse(SMALL, "small", (f'trust="{trust}"',))
        assert f'trust = "{trust}"' in to_toml(scenario)
        assert parse(to_toml(scenario), "small") == scenario
        assert scenario.signed == (trust == "signed")
