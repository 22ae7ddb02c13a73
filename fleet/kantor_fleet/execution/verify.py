"""`kantor verify`: check a recorded run, execute it again and compare."""

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from kantor_fleet.execution.experiment import reason
from kantor_fleet.execution.in_process_team import participant, play
from kantor_fleet.exits import Exit, fail
from kantor_protocol.base.machine import WORLD_SIM, Outputs, ParticipantId, StateMachine
from kantor_protocol.files.reading import UnreadableError, read_text
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import (
    Identities,
    is_genuine,
    unsigned_outputs,
)
from kantor_protocol.wire.messages import RefusedError, attestations_of
from kantor_worldsim.engine.process_faults import ProcessFaults
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.record import behaviour
from kantor_worldsim.record.journal import Digest, file_digest, read
from kantor_worldsim.record.process_events import TAKE_OVER
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    EnvelopeIndex,
    Opening,
    ProcessEvent,
    Record,
    StepRecord,
    encode_record,
    without_signatures,
)
from kantor_worldsim.record.run_folder import JOURNAL, MANIFEST, Manifest
from kantor_worldsim.world.inputs import InputFile, changes_since, inputs_of
from kantor_worldsim.world.world import World, WorldSetup

_REALTIME = "wall"
"""The name of the realtime exchange on record."""


def verify(folder: Path) -> Exit:
    """Print all findings on a run folder; NOT_MET if one of them is a failure."""
    return print_findings(findings(folder))


def print_findings(found: "list[Finding]") -> Exit:
    """Print a line for each finding; NOT_MET if one of them is a failure."""
    for passed, line in found:
        print(f"{'ok  ' if passed else 'FAIL'}  {line}")
    return Exit.DONE if all(passed for passed, _ in found) else Exit.NOT_MET


def findings(folder: Path, records: list[tuple[bytes, Record]] | None = None) -> "list[Finding]":
    """A finding on the file, on the rules and on the execution. records: the journal, if it has been read."""
    tree = read_manifest(folder)
    manifest = _settings(folder, tree)
    records = _journal(folder) if records is None else records
    opening = records[0][1] if records else None
    if not isinstance(opening, Opening):
        return [(False, f"{JOURNAL}: no opening record in it")]
    found = list(_findings_on_file(folder, manifest, records))
    try:
        opening.check()
    except (RefusedError, ScenarioError, ValueError) as error:
        problem = str(error).splitlines()[0]
        return [*found, (False, f"{JOURNAL}: no run can start from its opening: {problem}")]
    inputs = inputs_in(tree)
    changes = list(changes_since(inputs))
    if changes:
        found.append(
            (True, f"inputs: {', '.join(changes)} since the run; the record has what it read")
        )
    drawn_anew = not changes and (bool(inputs) or not _names_files(opening.scenario))
    execution = partial(_finding_of_execution, drawn_anew=drawn_anew)
    signed = (_finding_on_signatures,) if opening.scenario.signed else ()
    judges = (*signed, _finding_of_checker, execution)
    return [*found, *(_judged(judge, manifest, records) for judge in judges)]


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a run folder; ends the command if there is none that can be verified."""
    path = folder / MANIFEST
    try:
        manifest = json.loads(read_text(path))
    except UnreadableError as error:
        remedy = "give a folder that a run left" if error.missing else "it cannot be verified"
        fail(Exit.USAGE, f"{error}; {remedy}")
    except ValueError:
        fail(Exit.USAGE, f"{path}: not readable as JSON; it cannot be verified")
    if not isinstance(manifest, dict) or manifest.get("format") != 1:
        fail(Exit.USAGE, f"{path}: written by another version; verify it with that one")
    return manifest


def _settings(folder: Path, tree: dict[str, Any]) -> Manifest:
    """What a manifest says of how a run is verified; ends the command if that is not usable."""
    path = folder / MANIFEST
    try:
        manifest = msgspec.convert(tree, Manifest)
    except (msgspec.ValidationError, UnicodeEncodeError) as error:
        fail(Exit.USAGE, f"{path}: written by another version ({error}); verify it with that one")
    if manifest.behaviour > behaviour.current():
        fail(Exit.USAGE, f"{path}: written by a newer version; verify it with that one")
    return manifest


def inputs_in(manifest: dict[str, Any]) -> tuple[InputFile, ...]:
    """The files that a run was read from; none if its manifest does not say."""
    try:
        return msgspec.convert(manifest.get("inputs", ()), tuple[InputFile, ...])
    except (msgspec.ValidationError, UnicodeEncodeError):  # JSON may hold what is no text
        return ()


def _names_files(scenario: Scenario) -> bool:
    return bool(inputs_of(scenario, lambda _path: None))


def _journal(folder: Path) -> list[tuple[bytes, Record]]:
    path = folder / JOURNAL
    if not path.is_file():
        fail(Exit.USAGE, f"{path}: no such file; give a folder that a run left")
    return list(read(path))


Finding = tuple[bool, str]
"""Whether what was checked is in order, and a line about it."""


def _findings_on_file(
    folder: Path, manifest: Manifest, records: list[tuple[bytes, Record]]
) -> Iterator[Finding]:
    if manifest.digest is None:
        yield True, f"{JOURNAL}: the run was killed; {len(records)} records up to then"
        return
    same = file_digest(folder / JOURNAL) == manifest.journal_blake2b
    yield same, f"{JOURNAL}: {'as it was written' if same else 'changed since it was written'}"
    if manifest.record != "whole":
        yield True, f"{JOURNAL}: {manifest.record}; {len(records)} records up to then"
        return
    digest = Digest()
    for payload, record in records:
        digest.follow(record, payload)
    same = digest.hex == manifest.digest and digest.records == manifest.records
    yield same, f"digest of {digest.records} records: {digest.hex}"


def _judged(
    judge: Callable[[Manifest, list[tuple[bytes, Record]]], Finding],
    manifest: Manifest,
    records: list[tuple[bytes, Record]],
) -> Finding:
    """A finding; if the record is such that there can be none, that is the finding."""
    try:
        return judge(manifest, records)
    except Exception as error:  # noqa: BLE001  a forged record may provoke any
        return False, f"{JOURNAL}: no run goes on as it says: {reason(error)}"


def _finding_of_checker(manifest: Manifest, records: list[tuple[bytes, Record]]) -> Finding:
    virtual = manifest.exchange != _REALTIME
    checker = check((record for _, record in records), virtual=virtual)
    if not checker.count:
        return True, "checker: all rules held"
    return False, f"checker: {checker.count} violations, first: {checker.violations[0]}"


def _finding_on_signatures(_manifest: Manifest, records: list[tuple[bytes, Record]]) -> Finding:
    """Whether every attestation that a participant has sent is signed by its origin, with the keys on record.

    A robot that the scenario has lie may forge them.
    """
    opening, identities = records[0][1], _identities_in(records)
    assert isinstance(opening, Opening)
    if identities is None:
        return False, "signatures: the record does not say whose word counts"
    roster, count, forged = opening.scenario.roster, 0, 0
    liars = liars_of(opening.scenario.faults)
    for _, record in records:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            for envelope in step_record.outputs.outbox if step_record.outputs else ():
                for attestation in attestations_of(envelope):
                    count += 1
                    origin = roster[attestation.origin % len(roster)]
                    genuine = is_genuine(identities, origin, attestation)
                    if not genuine and step_record.name in liars:
                        forged += 1
                    elif not genuine:
                        at_s = f"t={step_record.now_ns * 1e-9:.3f} s"
                        what = f"{step_record.name} sends what {origin} has not signed"
                        return False, f"signatures: {at_s}: {what}, step {attestation.step}"
    but = f" but {forged} forged by {', '.join(sorted(liars))}" if forged else ""
    return True, f"signatures: {count} attestations, all signed by their origins{but}"


def _identities_in(records: list[tuple[bytes, Record]]) -> Identities | None:
    """Whose word counts in a run; None with `trust = "open"`."""
    return next((record for _, record in records[1:2] if isinstance(record, Identities)), None)


def _finding_of_execution(
    manifest: Manifest, records: list[tuple[bytes, Record]], *, drawn_anew: bool
) -> Finding:
    """The run executed again. What has changed since it was recorded may be why it differs, and then it says so."""
    opening = records[0][1]
    assert isinstance(opening, Opening)
    if manifest.exchange == _REALTIME or any(_unscheduled(opening.scenario, records)):
        passed, line = _replayed(opening, records)
    else:
        passed, line = _executed(opening, records, drawn_anew=drawn_anew)
    changes = behaviour.changes_since(manifest.behaviour, opening.scenario)
    if passed or not changes:
        return passed, line
    return True, (
        f"{line}, which proves nothing: recorded under behaviour {manifest.behaviour}, "
        f"this is {behaviour.current()}; changed since: {changes}"
    )


def _unscheduled(scenario: Scenario, records: list[tuple[bytes, Record]]) -> Iterator[bool]:
    """For each record of processes whether it has an event or an absence that the scenario does not schedule."""
    outages = ProcessFaults(scenario)
    for _, record in records:
        if isinstance(record, ProcessEvent):
            yield record.fault < 0
        elif isinstance(record, Batch) and record.absent:
            yield not all(outages.dies(name, record.now_ns) for name in record.absent)


def _executed(
    opening: Opening, records: list[tuple[bytes, Record]], *, drawn_anew: bool
) -> Finding:
    """Execute the run again in this process, and compare it record by record, of a signed run without signatures.

    drawn_anew: draw what it starts from again as well, and read its files; else take that from the record.
    """
    scenario, seed = opening.scenario, opening.seed
    setup = WorldSetup.of(scenario, seed) if drawn_anew else opening.setup
    expected = [each for each in records if not isinstance(each[1], Identities)]
    bare = _unsigned if scenario.signed else _as_it_is
    compared, differing = 0, -1

    def compare(record: Record) -> None:
        nonlocal compared, differing
        if isinstance(record, Identities) or compared == len(expected) or differing >= 0:
            return
        if bare(*expected[compared]) != bare(encode_record(record), record):
            differing = compared
        compared += 1

    whole = isinstance(records[-1][1], Ending)
    steps = len(expected) - (1 if whole else 0)
    play(scenario, seed, setup, [compare], stopped=lambda: compared >= steps or differing >= 0)
    if differing >= 0:
        return False, f"executed again: record {differing} differs"
    if compared < len(expected):
        return False, f"executed again: {compared} records, the journal has {len(expected)}"
    extent = "every byte but signatures" if scenario.signed else "every byte"
    return True, f"executed again: {compared} records, {extent} the same"


def _as_it_is(payload: bytes, _record: Record) -> bytes:
    return payload


def _unsigned(payload: bytes, record: Record) -> bytes:
    """An encoded record with all signatures zeroed."""
    bare = without_signatures(record)
    return payload if bare is record else encode_record(bare)


def _replayed(opening: Opening, records: list[tuple[bytes, Record]]) -> Finding:
    """Step every participant again from its recorded inputs, and compare its outputs."""
    team = _ReplayedTeam(opening, _identities_in(records))
    steps = 0
    for _, record in records:
        if isinstance(record, ProcessEvent):
            team.follow(record)
        elif isinstance(record, Batch):
            for step_record in record.step_records:
                if step_record.outputs is None:
                    continue
                name, recorded = step_record.name, step_record.outputs
                try:
                    outputs = team.step(step_record)
                except (KeyError, RefusedError):
                    line = f"{name} received at t={step_record.now_ns} a message that was not sent"
                    return False, f"replayed: {line}"
                if unsigned_outputs(outputs) != unsigned_outputs(recorded):
                    return False, f"replayed: {name} differs at its step {recorded.step}"
                steps += 1
            team.envelopes.add(record)
    return True, f"replayed: {steps} steps of {team.count} participants, all the same"


class _ReplayedTeam:
    """The participants of a record. A new incarnation takes over the body in the state that the world knows."""

    def __init__(self, opening: Opening, identities: Identities | None) -> None:
        self._identities = identities
        self.envelopes = EnvelopeIndex()
        self._opening = opening
        self._setup = opening.setup
        self._world = World(opening.scenario, opening.seed, self._setup)
        self._machines: dict[ParticipantId, StateMachine] = {}

    @property
    def count(self) -> int:
        """Number of participants that have stepped, without counting incarnations."""
        return len(self._machines)

    def follow(self, event: ProcessEvent) -> None:
        """Replace the machine of a process that returns as a new incarnation."""
        who = event.who
        if event.kind not in TAKE_OVER or who == WORLD_SIM:
            return
        if self._world.begin(who, event.incarnation):
            self._machines[who] = self._participant(who)

    def step(self, step_record: StepRecord) -> Outputs:
        """Outputs of a participant for recorded inputs. Raises KeyError for an envelope that was not sent."""
        name = step_record.name
        if name not in self._machines:
            self._machines[name] = self._participant(name)
        outputs = self._machines[name].step(self.envelopes.inputs(step_record))
        self._world.accept(name, step_record.now_ns, outputs)
        return outputs

    def _participant(self, name: ParticipantId) -> StateMachine:
        opening, body = self._opening, self._world.body(name)
        return participant(
            name, opening.scenario, opening.seed, self._setup, body, self._identities
        )
