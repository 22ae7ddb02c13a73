"""Bugs in the life of processes: logs, incarnations, outages, clocks, and the schedule of process faults."""

from collections.abc import Callable
from typing import Any

import msgspec

from campaign.planting import Patch, density, has, mutant, wrap
from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.machine import Body
from kantor_protocol.node import recovery
from kantor_protocol.node.recovery import InMemoryLog, KillableNode, RecoverableNode, WalContents
from kantor_protocol.scenario.faults.processes import (
    ClockFault,
    FullDisk,
    Impostor,
    Kill,
    Late,
    OnProcesses,
    Pause,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import decode_inputs
from kantor_worldsim.engine import process_faults
from kantor_worldsim.engine.process_faults import ProcessFaults, ScheduledProcessFault
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange


def _strikes_several(scenario: Scenario) -> bool:
    return any(isinstance(f, OnProcesses) and len(f.who) > 1 for f in scenario.faults)


@mutant("a step is logged after it was reported, and the log is trusted", has(Kill))
def late_write(patch: Patch) -> None:
    def kill(self: KillableNode) -> None:
        self._node = None
        del self._wal._inputs[-1:]

    patch.setattr(KillableNode, "kill", kill)
    patch.setattr(
        recovery,
        "_covers",
        lambda entries, body: entries.initial_state.incarnation == body.incarnation,
    )


@mutant("a torn log is taken for whole", has(Kill, disk=("torn",)))
def torn_wal_taken_for_whole(patch: Patch) -> None:
    patch.setattr(
        recovery,
        "_covers",
        lambda entries, body: entries.initial_state.incarnation == body.incarnation,
    )


@mutant("a process that starts again knows nothing, not even its incarnation", has(Kill))
def amnesia(patch: Patch) -> None:
    def start(self: KillableNode, body: Body, disk: str) -> tuple[int, int]:
        self._wal = InMemoryLog()
        newborn = Body(body.pose, 0, 0, body.incarnation)
        self._node = RecoverableNode(self._build, self._wal, newborn)
        return body.incarnation, body.step

    patch.setattr(KillableNode, "start", start)


@mutant(
    "after a lost disk the old incarnation goes on with an empty log",
    has(Kill, disk=("torn", "lost")),
)
def old_incarnation_used_again(patch: Patch) -> None:
    patch.setattr(recovery, "_reincarnated", lambda body: body)


@mutant("every start is a new incarnation, though the log is whole", has(Kill, disk=("kept",)))
def needless_incarnation(patch: Patch) -> None:
    def read(self: InMemoryLog) -> WalContents | None:
        return None

    patch.setattr(InMemoryLog, "read", read)


@mutant("asked again, a robot does its step once more", has(Kill, mid_step=(True,)))
def answering_a_turn_twice(patch: Patch) -> None:
    def step(self: RecoverableNode, entry: bytes) -> Any:
        self._wal.append(entry)
        return self._advance(decode_inputs(entry))

    patch.setattr(RecoverableNode, "step_encoded", step)


@mutant("a step is not counted now and then", density)
def lost_step_count(patch: Patch) -> None:
    def make(step: Any) -> Any:
        def stepped(self: DensityRobot, inputs: Any) -> Any:
            self._step -= self._step % 40 == 39
            return step(self, inputs)

        return stepped

    wrap(patch, DensityRobot, "step", make)


def _ignoring(patch: Patch, kind: type) -> None:
    """The exchange lets processes act that such a fault stops."""

    def make(init: Any) -> Any:
        def made(self: ProcessFaults, *arguments: Any, **named: Any) -> None:
            init(self, *arguments, **named)
            self._stops = {
                name: [window for window in windows if not isinstance(window.fault, kind)]
                for name, windows in self._stops.items()
            }

        return made

    wrap(patch, ProcessFaults, "__init__", make)


@mutant("dead processes go on acting", has(Kill))
def dead_robot_still_acts(patch: Patch) -> None:
    _ignoring(patch, Kill)
    patch.setattr(KillableNode, "kill", lambda _: None)


@mutant("a paused process goes on acting", has(Pause))
def paused_robot_still_acts(patch: Patch) -> None:
    _ignoring(patch, Pause)


@mutant("a step that cannot be logged is taken nevertheless", has(FullDisk))
def full_disk_ignored(patch: Patch) -> None:
    _ignoring(patch, FullDisk)


@mutant("a late participant acts from the start", has(Late))
def late_joiner_comes_early(patch: Patch) -> None:
    _ignoring(patch, Late)


@mutant("an impostor is let in", has(Impostor))
def impostor_let_in(patch: Patch) -> None:
    patch.setattr(InProcessExchange, "admits_impostor", lambda _self, _name: True)


@mutant(
    "world-sim judges by the clock of the robot",
    has(ClockFault),
)
def clock_skew_leaks_into_physics(patch: Patch) -> None:
    def make(step_record: Any) -> Any:
        def acted(self: Simulation, step: Any) -> Any:
            return step_record(self, msgspec.structs.replace(step, skew_ns=0))

        return acted

    wrap(patch, Simulation, "_accept", make)


@mutant(
    "a clock fault does nothing",
    has(ClockFault),
)
def clock_stays_right(patch: Patch) -> None:
    patch.setattr(process_faults.ProcessFaults, "skew_ns", lambda *_: 0)


@mutant("a clock that should run fast runs slow", has(ClockFault))
def clock_drifts_backwards(patch: Patch) -> None:
    def skew_ns(self: ClockFault, now_ns: int) -> int:
        drift_ns = (now_ns - self.from_ns) * round(self.rate_ppm) // 1_000_000
        return round(self.offset_s * 1e9) - drift_ns

    patch.setattr(ClockFault, "skew_ns", skew_ns)


# The schedule of process faults.


def _rescheduled(
    patch: Patch, change: Callable[[ScheduledProcessFault, Scenario], ScheduledProcessFault | None]
) -> None:
    """Every scheduled process fault is replaced, or left out."""

    def make(schedule_of: Any) -> Any:
        def made(scenario: Scenario) -> list[ScheduledProcessFault]:
            changed = (change(scheduled, scenario) for scheduled in schedule_of(scenario))
            return sorted(
                (scheduled for scheduled in changed if scheduled is not None),
                key=lambda scheduled: scheduled.at_ns,
            )

        return made

    wrap(patch, process_faults, "schedule_of", make)


@mutant("a process starts a tenth of its outage too early", has(Kill, disk=("kept",)))
def process_starts_early(patch: Patch) -> None:
    def earlier(scheduled: ScheduledProcessFault, scenario: Scenario) -> ScheduledProcessFault:
        fault = scenario.faults[scheduled.fault]
        if scheduled.kind != "start" or fault.until_ns is None:
            return scheduled
        early_ns = (fault.until_ns - fault.from_ns) // 10
        return scheduled._replace(at_ns=scheduled.at_ns - early_ns)

    _rescheduled(patch, earlier)


@mutant("of several processes in a fault only the first is struck", _strikes_several)
def only_the_first_is_struck(patch: Patch) -> None:
    def first(scheduled: ScheduledProcessFault, scenario: Scenario) -> ScheduledProcessFault | None:
        fault = scenario.faults[scheduled.fault]
        assert isinstance(fault, OnProcesses)
        return scheduled if scheduled.who == fault.who[0] else None

    _rescheduled(patch, first)


@mutant("a lost disk is kept", has(Kill, disk=("lost",)))
def lost_disk_kept(patch: Patch) -> None:
    _rescheduled(patch, lambda scheduled, _: scheduled._replace(disk="kept"))
