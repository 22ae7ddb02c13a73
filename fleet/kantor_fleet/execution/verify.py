"""`kantor verify`: execute a recorded run again and compare."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kantor_fleet.execution.in_process_team import participant, play
from kantor_fleet.exits import Exit, fail
from kantor_protocol.base.machine import WORLD_SIM, Outputs, ParticipantId, StateMachine
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import RefusedError
from kantor_worldsim.engine.process_faults import ProcessFaults
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.record.journal import Digest, file_digest, read
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    EnvelopeIndex,
    Opening,
    ProcessEvent,
    Record,
    StepRecord,
    encode_record,
)
from kantor_worldsim.record.run_folder import JOURNAL, MANIFEST
from kantor_worldsim.world.world import World, WorldSetup


def verify(folder: Path) -> Exit:
    """Print a verdict on each thing that can be verified; NOT_MET if any differs."""
    found = verdicts(folder)
    for held, line in found:
        print(f"{'ok  ' if held else 'FAIL'}  {line}")
    return Exit.DONE if all(held for held, _ in found) else Exit.NOT_MET


def verdicts(folder: Path, records: list[tuple[bytes, Record]] | None = None) -> "list[Verdict]":
    """A verdict on each thing that can be verified. records: the journal, if it has been read."""
    manifest = _manifest(folder)
    records = _journal(folder) if records is None else records
    if not records or not isinstance(records[0][1], Opening):
        return [(False, f"{JOURNAL}: no opening record in it")]
    found = list(_verdicts_on_file(folder, manifest, records))
    try:
        found += [
            _verdict_of_checker(manifest, records),
            _verdict_of_execution(manifest, records),
        ]
    except (
        RefusedError,
        ScenarioError,
        ValueError,
    ) as error:  # an opening that nothing can start from
        found.append((False, f"{JOURNAL}: its opening is no use: {str(error).splitlines()[0]}"))
    return found


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        fail(Exit.USAGE, f"{path}: no such file; give a folder that a run left")
    except (OSError, ValueError):
        fail(Exit.USAGE, f"{path}: not readable as JSON; it cannot be verified")
    if not isinstance(manifest, dict) or manifest.get("format") != 1:
        fail(Exit.USAGE, f"{path}: written by another version; verify it with that one")
    return manifest


def _journal(folder: Path) -> list[tuple[bytes, Record]]:
    try:
        return list(read(folder / JOURNAL))
    except FileNotFoundError:
        fail(Exit.USAGE, f"{folder / JOURNAL}: no such file; give a folder that a run left")


Verdict = tuple[bool, str]
"""Whether it held, and a line about it."""


def _verdicts_on_file(
    folder: Path, manifest: dict[str, Any], records: list[tuple[bytes, Record]]
) -> Iterator[Verdict]:
    if "digest" not in manifest:
        yield True, f"{JOURNAL}: the run was killed; {len(records)} records up to then"
        return
    same = file_digest(folder / JOURNAL) == manifest.get("journal_blake2b")
    yield same, f"{JOURNAL}: {'as it was written' if same else 'changed since it was written'}"
    if manifest.get("record") != "whole":
        yield True, f"{JOURNAL}: {manifest.get('record')}; {len(records)} records up to then"
        return
    digest = Digest()
    for payload, _ in records:
        digest.add(payload)
    same = digest.hex == manifest["digest"] and digest.records == manifest.get("records")
    yield same, f"digest of {digest.records} records: {digest.hex}"


def _verdict_of_checker(manifest: dict[str, Any], records: list[tuple[bytes, Record]]) -> Verdict:
    virtual = manifest.get("exchange") != "wall"
    checker = check((record for _, record in records), virtual=virtual)
    if not checker.count:
        return True, "checker: all rules held"
    return False, f"checker: {checker.count} complaints, first: {checker.violations[0]}"


def _verdict_of_execution(manifest: dict[str, Any], records: list[tuple[bytes, Record]]) -> Verdict:
    opening = records[0][1]
    assert isinstance(opening, Opening)
    if manifest.get("exchange") == "wall" or any(_chance(opening.scenario, records)):
        return _replayed(opening, records)
    return _executed(opening, records)


def _chance(scenario: Scenario, records: list[tuple[bytes, Record]]) -> Iterator[bool]:
    """Of every record whether something happened that no scenario orders."""
    outages = ProcessFaults(scenario)
    for _, record in records:
        if isinstance(record, ProcessEvent):
            yield record.fault < 0
        elif isinstance(record, Batch) and record.absent:
            yield not all(outages.dies(name, record.now_ns) for name in record.absent)


def _executed(opening: Opening, records: list[tuple[bytes, Record]]) -> Verdict:
    """The whole run anew, in process, record by record."""
    scenario, seed = opening.scenario, opening.seed
    world = scenario.map
    from_files = scenario.samples.file or scenario.targets.file or (world and world.file)
    site = opening.site if from_files else WorldSetup.of(scenario, seed)
    expected = iter(payload for payload, _ in records)
    compared, differing = 0, -1

    def compare(record: Record) -> None:
        nonlocal compared, differing
        payload = next(expected, None)
        if payload is None or differing >= 0:
            return
        if payload != encode_record(record):
            differing = compared
        compared += 1

    whole = isinstance(records[-1][1], Ending)
    steps = len(records) - (1 if whole else 0)
    play(scenario, seed, site, [compare], stopped=lambda: compared >= steps or differing >= 0)
    if differing >= 0:
        return False, f"executed again: record {differing} differs"
    if compared < len(records):
        return False, f"executed again: {compared} records, the journal has {len(records)}"
    return True, f"executed again: {compared} records, every byte the same"


def _replayed(opening: Opening, records: list[tuple[bytes, Record]]) -> Verdict:
    """Every participant anew, each from the inbox that it had."""
    team = _Team(opening)
    steps = 0
    for _, record in records:
        if isinstance(record, ProcessEvent):
            team.follow(record)
        elif isinstance(record, Batch):
            for step_record in record.step_records:
                if step_record.outputs is None:
                    continue
                try:
                    outputs = team.step(step_record)
                except (KeyError, RefusedError):
                    return (
                        False,
                        f"replayed: {step_record.name} heard at t={step_record.now_ns} what nobody sent",
                    )
                if outputs != step_record.outputs:
                    return (
                        False,
                        f"replayed: {step_record.name} differs at its step {step_record.outputs.step}",
                    )
                steps += 1
            team.mailbag.post(record)
    return True, f"replayed: {steps} steps of {team.count} participants, all the same"


class _Team:
    """The participants of a record. A new incarnation takes over the body as the world then knows it."""

    def __init__(self, opening: Opening) -> None:
        self.mailbag = EnvelopeIndex()
        self._opening = opening
        self._site = opening.site
        self._world = World(opening.scenario, opening.seed, self._site)
        self._machines: dict[ParticipantId, StateMachine] = {}

    @property
    def count(self) -> int:
        """How many have acted, incarnations aside."""
        return len(self._machines)

    def follow(self, incident: ProcessEvent) -> None:
        """A process that comes back goes on, unless it is another incarnation."""
        who = incident.who
        if incident.what not in {"start", "join"} or who == WORLD_SIM:
            return
        if self._world.begin(who, incident.incarnation):
            self._machines[who] = self._participant(who)

    def step(self, step_record: StepRecord) -> Outputs:
        """What comes of an act's inputs. Raises KeyError for what nobody sent."""
        name = step_record.name
        if name not in self._machines:
            self._machines[name] = self._participant(name)
        outputs = self._machines[name].step(self.mailbag.inputs(step_record))
        self._world.accept(name, step_record.now_ns, outputs)
        return outputs

    def _participant(self, name: ParticipantId) -> StateMachine:
        opening, body = self._opening, self._world.body(name)
        return participant(name, opening.scenario, opening.seed, self._site, body)
