"""What must happen some day: quiet about sound runs that come to rest, and each rule can be broken."""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
import pytest

from kantor_fleet.execution.in_process_team import team, team_identities
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, State
from kantor_protocol.base.varint import put_uint
from kantor_protocol.scenario.faults.liars import LIES
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import decode_gossip, encode_gossip
from kantor_protocol.wire.version_vector import read_version_vector
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.liveness import LivenessChecker, settling_ns
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.records import Batch, Ending, Record, StepRecord
from kantor_worldsim.world.world import WorldSetup
from support.records import step_records
from support.strategies import mission

SIZE = ("samples.count=60", "energy.points=90", "energy.steps=60", "limit_s=300")
LOST = "faults=[{kind='kill', who=['r2'], from_s=0.75, until_s=1.5, disk='lost'}]"
CUT = "faults=[{kind='partition', shape='halves', from_s=0.3, until_s=3.0}]"
AWAY = "faults=[{kind='kill', who=['supervisor'], from_s=0.5, until_s=2.0}]"
GUIDED = "coordination=centralized"
SIGNED = "trust=signed"
GONE = "faults=[{kind='kill', who=['r2'], from_s=2.05}]"


def lying(lie: str) -> str:
    return f"faults=[{{kind='byzantine', who=['r2'], lie='{lie}', from_s=0.3, until_s=2.0}}]"


class _Patient(Simulation):
    """A simulation in which the mission goes on for a while when all robots rest."""

    rested_ns = -1

    @property
    def over(self) -> str | None:
        reason = super().over
        if reason is not None and self.rested_ns < 0:
            self.rested_ns = max(self.now_ns, 4_000_000_000)
        longer_ns = settling_ns(self.scenario, len(self.scenario.roster))
        return reason if self.now_ns > self.rested_ns + longer_ns else None


def rested(*overrides: str, seed: int = 1) -> list[Record]:
    """The records of a mission that goes on until news could be everywhere."""
    scenario: Scenario = mission(*SIZE, *overrides)
    setup = WorldSetup.of(scenario, seed)
    records: list[Record] = []
    identities = team_identities(scenario, seed)
    simulation = _Patient(scenario, seed, setup, [records.append], identities)
    exchange = InProcessExchange(team(scenario, seed, setup))
    simulate(simulation, exchange, seed, lambda: False, exchange)
    return records


def judged(records: Sequence[Record]) -> LivenessChecker:
    checker = LivenessChecker()
    pipeline = Pipeline(checker)
    for record in records:
        pipeline.observe(record)
    return checker


def rules(records: Sequence[Record]) -> set[str]:
    return {complaint.partition(":")[0] for complaint in judged(records).violations}


@pytest.mark.parametrize("merge", [("merge=ledger",), ("merge=min", "claims=false")])
@pytest.mark.parametrize("fault", ["faults=[]", LOST, CUT])
@pytest.mark.parametrize("guided", [(), (GUIDED,)])
@pytest.mark.parametrize("radio", [(), ("radio.drop=0.2",), ("radio.delay_s=0.25",)])
def test_all_is_known_to_all_in_the_end(
    merge: tuple[str, ...], fault: str, guided: tuple[str, ...], radio: tuple[str, ...]
) -> None:
    """Whatever happened before: who can hear one another hold the same when all is quiet."""
    checker = judged(rested(*merge, fault, *guided, *radio))

    assert checker.violations == []
    assert {"L1", "L2"} <= checker.judged
    assert ("I8" in checker.judged) == ("merge=ledger" in merge)


def test_supervisor_that_dies_is_given_up_and_taken_back() -> None:
    """Robots talk to all robots meanwhile, and no rule is broken."""
    records = rested(AWAY, GUIDED)
    checker = judged(records)
    targets = [
        e.target
        for step_record in step_records(records, "r1")
        if step_record.outputs
        for e in step_record.outputs.outbox
    ]

    assert checker.violations == []
    assert "L3" in checker.judged
    assert {SUPERVISOR, EVERYBODY} == set(targets)
    assert targets[-1] == SUPERVISOR


def test_nothing_is_judged_before_it_can_be_known() -> None:
    """A run that ends while robots move, or under a fault, says nothing of what would have been."""
    lasting = judged(rested("faults=[{kind='partition', shape='halves'}]"))

    assert lasting.violations == []
    assert lasting.judged == {"L2"}


def altered(records: Sequence[Record], change: Callable[[StepRecord], StepRecord]) -> list[Record]:
    """The records with every step record changed."""
    return [
        msgspec.structs.replace(r, step_records=tuple(map(change, r.step_records)))
        if isinstance(r, Batch)
        else r
        for r in records
    ]


def returning(records: Sequence[Record], name: str, **values: object) -> list[Record]:
    """The records with everything that a participant returned changed."""

    def change(step_record: StepRecord) -> StepRecord:
        if step_record.name != name or step_record.outputs is None:
            return step_record
        told = msgspec.structs.replace(step_record.outputs, **values)
        return msgspec.structs.replace(step_record, outputs=told)

    return altered(records, change)


def said(version_vector: Sequence[int], step_record: StepRecord) -> object:
    """The last message of an act with other log lengths."""
    assert step_record.outputs is not None
    (envelope,) = step_record.outputs.outbox
    news = decode_gossip(envelope.body)
    rest = news.version_vector[len(_uints(read_version_vector(news.version_vector, 3) or [])) :]
    body = encode_gossip(
        msgspec.structs.replace(news, version_vector=_uints(version_vector) + rest)
    )
    return (msgspec.structs.replace(envelope, body=body),)


def _uints(values: Sequence[int]) -> bytes:
    buffer, at = np.zeros(10 * len(values), dtype=np.uint8), 0
    for value in values:
        at = put_uint(buffer, at, value)
    return buffer[:at].tobytes()


def have_of(step_record: StepRecord) -> list[int]:
    assert step_record.outputs is not None
    return (
        read_version_vector(decode_gossip(step_record.outputs.outbox[0].body).version_vector, 3)
        or []
    )


def test_who_never_learns_is_named() -> None:
    """L1: a participant that lacks entries, and one whose view is another."""
    records = rested()
    last = step_records(records, "r2")[-1]
    less = [have_of(last)[0] - 1, *have_of(last)[1:]]

    assert rules(returning(records, "r2", outbox=said(less, last))) == {"L1"}
    assert rules(returning(records, "r2", lowered=b"")) == {"L1"}


def test_mission_without_an_end_is_named() -> None:
    """L2."""
    records = rested()
    ending = records[-1]
    assert isinstance(ending, Ending)

    assert rules([*records[:-1], Ending(ending.now_ns, "limit")]) == {"L2"}
    assert rules([*records[:-1], Ending(ending.now_ns, "interrupted")]) == set()


@pytest.mark.parametrize("target", [SUPERVISOR, EVERYBODY])
def test_who_does_not_turn_to_others_is_named(target: str) -> None:
    """L3: one that waits for a dead supervisor, and one that ignores it when it is back."""
    records = rested(AWAY, GUIDED)

    def change(step_record: StepRecord) -> StepRecord:
        if step_record.name != "r1" or step_record.outputs is None:
            return step_record
        box = tuple(msgspec.structs.replace(e, target=target) for e in step_record.outputs.outbox)
        told = msgspec.structs.replace(step_record.outputs, outbox=box)
        return msgspec.structs.replace(step_record, outputs=told)

    assert rules(altered(records, change)) == {"L3"}


def test_lost_entries_are_named() -> None:
    """I8: entries that a robot has consumed and that no participant holds, not even itself."""
    records = rested()
    told = [*records]
    for name in ("r1", "r2", "r3"):
        last = step_records(records, name)[-1]
        version_vector = have_of(last)
        told = returning(
            told,
            name,
            outbox=said([version_vector[0], version_vector[1] - 1, version_vector[2]], last),
        )

    assert rules(told) == {"I8"}


def test_what_a_fault_has_held_up_still_merges_when_it_arrives() -> None:
    """Messages under way put off the judgement until they have arrived and had time to spread."""
    records = rested(CUT)
    sent = next(i for i, r in enumerate(records) if isinstance(r, Batch) and r.decisions)
    batch = records[sent]
    assert isinstance(batch, Batch)
    assert "L1" in judged(records).judged
    for before_the_end_ns, rules_judged in ((1, False), (-1, True)):
        due_ns = records[-1].now_ns - before_the_end_ns  # type: ignore[union-attr]
        late = msgspec.structs.replace(batch.decisions[0], due_ns=due_ns)
        held_up = msgspec.structs.replace(batch, decisions=(late, *batch.decisions[1:]))
        checker = judged([*records[:sent], held_up, *records[sent + 1 :]])

        assert ("L1" in checker.judged) == rules_judged


# Signed missions, and liars.


@pytest.mark.parametrize("guided", [(), (GUIDED,)])
@pytest.mark.parametrize("lie", LIES)
def test_beside_a_liar_the_honest_come_to_know_the_same(lie: str, guided: tuple[str, ...]) -> None:
    """Rules of the honest are judged as ever, and none is broken."""
    checker = judged(rested(SIGNED, lying(lie), *guided))

    assert checker.violations == []
    assert {"L1", "L2", "I8"} <= checker.judged


def test_what_the_honest_hold_of_a_liar_does_not_count() -> None:
    records = rested(SIGNED, lying("overstate"))
    last = step_records(records, "r1")[-1]
    honest, liar, other = have_of(last)

    assert rules(returning(records, "r1", outbox=said([honest, liar - 1, other], last))) == set()
    assert rules(returning(records, "r1", outbox=said([honest, liar, other - 1], last))) == {"L1"}


def test_a_mission_that_only_a_liar_keeps_open_has_come_to_its_end() -> None:
    records = rested(SIGNED, lying("teleport"))
    ending = records[-1]
    assert isinstance(ending, Ending)
    cut = [*records[:-1], Ending(ending.now_ns, "limit")]

    assert rules(returning(cut, "r2", state=State.EXPLORING)) == set()
    assert rules(returning(cut, "r1", state=State.EXPLORING)) == {"L2"}


def test_of_the_dead_only_what_they_have_attested_is_passed_on() -> None:
    """What r2 has said after its last attestation who was there may know, and nobody else."""
    records = rested(SIGNED, GONE)
    attested = max(
        each.length
        for step_record in step_records(records, "r2")
        if step_record.outputs is not None
        for envelope in step_record.outputs.outbox
        for each in decode_gossip(envelope.body).attestations
        if each.origin == 1
    )
    last = step_records(records, "r1")[-1]
    mine, gone, other = have_of(last)

    assert 0 < attested < gone
    assert rules(records) == set()
    assert rules(returning(records, "r1", outbox=said([mine, attested, other], last))) == set()
    less = said([mine, attested - 1, other], last)
    assert rules(returning(records, "r1", outbox=less)) == {"L1"}
