"""The runs behind a figure: settings in, measured measured out."""

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from kantor_fleet.execution.experiment import Case, Outcome, reason
from kantor_fleet.execution.in_process_team import play, team
from kantor_fleet.scenarios.catalog import find
from kantor_fleet.sweep.plan import RunKey, plan
from kantor_protocol.base.machine import SUPERVISOR, Inputs, Outputs, StateMachine
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.metrics.density import DensityRow
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.records import Record
from kantor_worldsim.world.world import WorldSetup

EXACT_EVERY = 100
"""Periods from one exact distance to the next, in the measured that have them."""


class Setting(NamedTuple):
    """A packaged scenario with overrides."""

    scenario: str
    overrides: tuple[str, ...] = ()
    exact: bool = False
    most: int = 1_000_000
    """The most runs that are useful, however many a figure asks for."""

    @property
    def text(self) -> str:
        """The setting as on a command line."""
        return " ".join((self.scenario, *self.overrides))

    def find(self) -> Scenario:
        """The scenario. Raises ScenarioError."""
        return find(self.scenario, self.overrides)

    def cases(self, seeds: Iterable[int]) -> list[tuple[RunKey, Case]]:
        """Its runs with these seeds, each with its key in the journal."""
        text = ",".join(map(str, seeds))
        return list(plan(self.scenario, (), text, self.overrides, exact=self.exact).cases())


class Moment(NamedTuple):
    """A point of the curves of a run on a map, over eight regions."""

    tick: int
    wtv: float
    epv: float


class MeasuredRun(Outcome, frozen=True, kw_only=True):
    """An outcome with the rows and the curves of the run."""

    rows: tuple[DensityRow, ...] = ()
    """Rows of a run on a density."""
    course: tuple[Moment, ...] = ()
    """Curves of a run on a map."""
    robots_s: float = 0.0
    """CPU seconds inside the robots' steps: planning, weights and messages."""


MeasuredRuns = Mapping[Setting, Sequence[MeasuredRun]]
"""Runs by setting, in the order of the seeds."""


class _TimedParticipant:
    """A participant whose steps are timed."""

    def __init__(self, machine: StateMachine) -> None:
        self._machine = machine
        self.spent_ns = 0

    def step(self, inputs: Inputs, /) -> Outputs:
        start_ns = time.process_time_ns()
        outputs = self._machine.step(inputs)
        self.spent_ns += time.process_time_ns() - start_ns
        return outputs


def run_measured(case: Case) -> MeasuredRun:
    """Run a case with every checker, and keep its rows and curves."""
    try:
        return _run_one(case)
    except Exception as error:  # noqa: BLE001  reported with the others at the end
        return MeasuredRun(failed=reason(error))


def _run_one(case: Case) -> MeasuredRun:
    scenario, seed = case.scenario, case.seed
    setup = WorldSetup.of(scenario, seed)
    machines = team(scenario, seed, setup)
    timed = {
        name: _TimedParticipant(machine)
        for name, machine in machines.items()
        if not isinstance(machine, KillableNode)  # the killed are recognised by this type
    }
    recording = Recording(
        scenario, seed, "in-process", exact_every=EXACT_EVERY if case.exact else None
    )
    play(scenario, seed, setup, [recording.observe], machines=machines | timed)
    spent_ns = sum(robot.spent_ns for name, robot in timed.items() if name != SUPERVISOR)
    result = recording.finish()
    rows = recording.metrics.rows
    mapping = scenario.map is not None
    return MeasuredRun(
        result=result,
        failed=result.complaints[0] if result.complaints else None,
        rows=() if mapping else tuple(rows),
        course=tuple(Moment(row.tick, row.wtv, row.epv) for row in rows) if mapping else (),
        robots_s=spent_ns * 1e-9,
    )


def records_of(setting: Setting, seed: int) -> list[Record]:
    """All records of one run, for a picture."""
    scenario = setting.find()
    setup = WorldSetup.of(scenario, seed)
    records: list[Record] = []
    play(scenario, seed, setup, [records.append])
    return records
