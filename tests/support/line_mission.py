"""A mission on a line whose every step a test gives, and the metrics of records."""

from collections.abc import Iterable

import numpy as np

from kantor_protocol.base.machine import Observation, Outputs, ParticipantId, Pose
from kantor_protocol.scenario.load import parse
from kantor_worldsim.observers.metrics.density import DensityMetrics, DensityRow
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.records import Batch, Ending, Record, StepRecord, opening_of
from kantor_worldsim.world.world import StepVerdict, WorldSetup
from support.records import pairs

PERIOD_NS = 100_000_000

LINE = """
name = "line"
merge = "min"
claims = false
domain = {min_m = [0.0, 0.0], max_m = [40.0, 1.0]}
robots = {count = 2}
starts = {poses_m = [[0.0, 0.0], [40.0, 0.0]]}
energy = {points = 4}
samples = {count = 2}
density = [{mean_m = [0.0, 0.0], variance_m2 = [1.0, 1.0]}]
metrics = {every = 1}
"""
SAMPLES_M = ((10.0, 0.0), (30.0, 0.0))
"""N = 2 and M = 4: two units a sample, one a point; a unit is a quarter of the mass."""


def measured(records: Iterable[Record]) -> DensityMetrics:
    """The metrics that have followed some records."""
    metrics = DensityMetrics()
    pipeline = Pipeline(metrics)
    for record in records:
        pipeline.observe(record)
    return metrics


def result_of(metrics: DensityMetrics) -> Result:
    return metrics.result(exchange="-", digest="-", wall_s=0.0, record="whole", complaints=())


class LineMission:
    """The metrics of two robots on a line with two samples: r1 comes from the left, r2 from the right."""

    def __init__(self, *overrides: str) -> None:
        scenario = parse(LINE, "line", overrides)
        setup = WorldSetup(
            np.array(SAMPLES_M), np.zeros((0, 2)), np.array([[0.0, 0.0], [40.0, 0.0]])
        )
        self.metrics = DensityMetrics()
        self.pipeline = Pipeline(self.metrics)
        self.pipeline.observe(opening_of(scenario, 1, setup, {"r1": (), "r2": ()}))
        self.tick = 0

    def play(self, *step_records: StepRecord) -> None:
        """One period."""
        self.tick += 1
        self.pipeline.observe(Batch(self.tick * PERIOD_NS, step_records, (), 0))

    def step_record(
        self,
        name: ParticipantId,
        x_m: float,
        sample: int,
        left: int,
        violations: tuple[str, ...] = (),
    ) -> StepRecord:
        """A robot goes to x and ships one unit to a sample, of which its view then holds `left`."""
        pose = Pose(x_m, 0.0)
        return StepRecord(
            name,
            self.tick * PERIOD_NS,
            Observation(self.tick, pose),
            (),
            Outputs(self.tick + 1, pose, spent=pairs((sample, 1)), lowered=pairs((sample, left))),
            StepVerdict(pose, violations=violations),
        )

    def rows(self) -> list[DensityRow]:
        """The rows of the mission, which ends here."""
        self.pipeline.observe(Ending(self.tick * PERIOD_NS, "done"))
        return self.metrics.rows
