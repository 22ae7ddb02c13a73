"""Verifying runs whose processes failed: executed again, or replayed incarnation by incarnation."""

import json
from pathlib import Path

import msgspec
import pytest

from kantor_fleet.execution.in_process_team import team
from kantor_fleet.execution.verify import verify
from kantor_fleet.exits import Exit
from kantor_protocol.base.machine import Exchange, Inputs, Outputs, ParticipantId
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.run_folder import MANIFEST
from kantor_worldsim.world.inputs import inputs_of
from kantor_worldsim.world.world import WorldSetup
from support.strategies import SMALL

TROUBLE = """
[[faults]]
kind = "kill"
who = ["r1"]
from_s = 0.72
until_s = 1.02
disk = "lost"

[[faults]]
kind = "kill"
who = ["r1", "r2"]
from_s = 1.52
until_s = 2.02
disk = "torn"
mid_step = true

[[faults]]
kind = "kill"
who = ["r3"]
from_s = 1.12
until_s = 2.42
mid_step = true

[[faults]]
kind = "clock"
who = ["r3"]
from_s = 1.0
offset_s = -0.5

[[faults]]
kind = "kill"
who = ["worldsim"]
from_s = 2.6
until_s = 3.3

[[faults]]
kind = "late"
who = ["r2"]
until_s = 0.45
"""
PACES = {
    "concurrent": (),
    "supervised": ("coordination=centralized", "clock.order=turn", "radio.delay_s=0.1"),
}


def troubled(*overrides: str) -> Scenario:
    """A small mission in which every robot and world-sim die at least once."""
    roomy = ("samples.count=60", "energy.points=90", "energy.steps=60", "limit_s=12")
    return parse(SMALL + TROUBLE, "troubled", (*roomy, "radio.drop=0.2", *overrides))


def recorded(scenario: Scenario, folder: Path, machines: Exchange | None = None) -> Result:
    """Play a mission into a run folder."""
    recording = Recording(scenario, 1, "in-process", folder)
    setup = WorldSetup.of(scenario, 1)
    simulation = Simulation(scenario, 1, setup, [recording.observe])
    exchange = InProcessExchange(team(scenario, 1, setup))
    simulate(simulation, machines or exchange, 1, lambda: False, exchange)
    return recording.finish()


def as_exchange(folder: Path, exchange: str) -> None:
    """Write another exchange into the manifest."""
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | {"exchange": exchange}))


@pytest.mark.parametrize("pace", list(PACES))
def test_scheduled_faults_are_executed_again(
    pace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Deaths, absences and new incarnations are in the scenario: every byte comes out the same."""
    scenario = troubled(*PACES[pace])
    recorded(scenario, tmp_path)
    code = verify(tmp_path)

    out = capsys.readouterr().out
    assert "every byte the same" in out
    assert (code, "FAIL" in out) == (Exit.DONE, False), out


@pytest.mark.parametrize("pace", list(PACES))
def test_incarnations_are_replayed(
    pace: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in realtime: machines go on after deaths, or take over the body in the state that the world knows."""
    scenario = troubled(*PACES[pace])
    recorded(scenario, tmp_path)
    as_exchange(tmp_path, "wall")
    verify(tmp_path)

    out = capsys.readouterr().out
    assert f"steps of {len(scenario.roster)} participants, all the same" in out, out


class SlowBus:
    """An exchange in which r1 does not answer at times, as over a bus that is too slow."""

    def __init__(self, scenario: Scenario) -> None:
        self._exchange = InProcessExchange(team(scenario, 1, WorldSetup.of(scenario, 1)))

    def __call__(self, inputs: dict[ParticipantId, Inputs], /) -> dict[ParticipantId, Outputs]:
        asleep = {"r1"} if inputs["r1"].now_ns == 500_000_000 else set()
        self.asked = getattr(self, "asked", 0) + bool(asleep)
        given = {who: its for who, its in inputs.items() if who not in asleep or self.asked > 3}
        return dict(self._exchange(given))


def test_absence_that_no_fault_schedules_is_replayed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Executed again it would not happen; the inboxes are on record all the same."""
    scenario = parse(SMALL, "small", ("limit_s=3", "energy.steps=60"))
    result = recorded(scenario, tmp_path, SlowBus(scenario))  # type: ignore[arg-type]
    code = verify(tmp_path)

    out = capsys.readouterr().out
    assert result.absences == 3
    assert "participants, all the same" in out
    assert code == Exit.DONE, out


def from_points(folder: Path, points: str) -> Scenario:
    """A small mission whose samples are in a file."""
    path = folder / "points.csv"
    path.write_text(points)
    return parse(SMALL, "small", (f"samples.file={path}", "samples.count=9", "limit_s=1"))


def test_an_input_that_has_changed_since_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run is executed from its record, and is as sound as it was."""
    points = "\n".join(f"{x},{x}" for x in range(10, 90, 10))
    recorded(from_points(tmp_path, points), tmp_path)
    assert verify(tmp_path) is Exit.DONE
    assert "inputs" not in capsys.readouterr().out

    from_points(tmp_path, points + "\n11,11")
    assert verify(tmp_path) is Exit.DONE
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "inputs" in line]
    assert line.startswith(f"ok    inputs: samples.file {tmp_path / 'points.csv'} has changed")


def test_inputs_as_they_were_are_read_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A record that begins with other samples than its files give is found out."""
    points = "\n".join(f"{x},{x}" for x in range(10, 90, 10))
    recorded(from_points(tmp_path, points), tmp_path)
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    from_points(tmp_path, points.replace("10,10", "10,11"))
    now = [msgspec.to_builtins(file) for file in inputs_of(from_points(tmp_path, "1,1"))]
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | {"inputs": now}))

    assert verify(tmp_path) is Exit.NOT_MET
    assert "FAIL  executed again: record 0 differs" in capsys.readouterr().out


@pytest.mark.parametrize("inputs", [None, 3, [{"key": 1}], [["a"]], "x"])
def test_a_manifest_that_does_not_say_its_inputs_is_verified_from_the_record(
    tmp_path: Path, inputs: object
) -> None:
    """As one of an earlier version, or a damaged one."""
    recorded(from_points(tmp_path, "10,10\n20,20\n"), tmp_path)
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | {"inputs": inputs}))
    (tmp_path / "points.csv").unlink()

    assert verify(tmp_path) is Exit.DONE


@pytest.mark.parametrize("content", [b"[" * 100_000, b"\xff", b"{", b"[]", b'{"format": 2}'])
def test_a_manifest_that_is_none_is_refused(
    tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line with its path, and exit code 2."""
    (tmp_path / MANIFEST).write_bytes(content)
    with pytest.raises(SystemExit) as ended:
        verify(tmp_path)

    err = capsys.readouterr().err
    assert ended.value.code == 2
    assert err.startswith(f"kantor: {tmp_path / MANIFEST}: ")
    assert err.count("\n") == 1
