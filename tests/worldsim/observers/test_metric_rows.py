"""Rows of metrics: how often they come, the file with them, and the snapshot of the last ones."""

from pathlib import Path

import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.metrics.density import DensityMetrics, DensityRow
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record.records import Batch, Record, opening_of
from kantor_worldsim.world.world import WorldSetup
from support.line_mission import PERIOD_NS, LineMission, measured
from support.records import Play
from support.strategies import mission


def test_rows_come_once_a_period_from_the_start_to_the_end(played: Play) -> None:
    """With metrics.every = 1 there is a row for time 0 and one for every tick, the last included."""
    rows = measured(played("metrics.every=1")).rows

    assert [row.tick for row in rows] == list(range(len(rows)))
    assert [row.time_s for row in rows] == pytest.approx([0.1 * i for i in range(len(rows))])
    assert (rows[0].energy_spent, rows[0].mass_left) == (0, 1.0)
    assert rows[-1].mass_left == 0.0


@pytest.mark.parametrize("every", [2, 7])
def test_rows_may_be_fewer(played: Play, every: int) -> None:
    """Every so many ticks, and the last one. The tight bound's prices follow the rows, it may differ."""
    whole = measured(played("metrics.every=1")).rows
    rows = measured(played(f"metrics.every={every}")).rows
    ticks = sorted({*range(0, len(whole), every), len(whole) - 1})

    assert [row.tick for row in rows] == ticks
    loose = [row._replace(w_ub_tight=None) for row in rows]
    assert loose == [whole[tick]._replace(w_ub_tight=None) for tick in ticks]
    for row, tick in zip(rows, ticks, strict=True):
        assert (row.w_ub_tight is None) == (whole[tick].w_ub_tight is None)


def test_bound_and_mass_never_rise_in_turn(played: Play) -> None:
    """In turn, with all robots in range, nothing is filled twice: the tight bound stays to the end."""
    rows = measured(played("metrics.every=1", "clock.order=turn")).rows
    masses = [row.mass_left for row in rows]

    assert masses == sorted(masses, reverse=True)
    assert all(row.w_ub_tight is not None for row in rows)
    assert all(row.w_ub_tight <= row.w_ub_paper for row in rows if row.w_ub_tight is not None)


def test_snapshot_before_any_record_is_empty() -> None:
    """Progress can be asked for at any time."""
    assert DensityMetrics().snapshot().energy_spent == 0


def test_snapshot_has_the_rate_of_deliveries() -> None:
    """Deliveries a simulated second, over the last rows."""
    line = LineMission()
    decisions = (DeliveryDecision("r1", 1, "r2", 0), DeliveryDecision("r2", 1, "r1", DROPPED))
    for tick in range(1, 31):
        line.pipeline.observe(Batch(tick * PERIOD_NS, (), decisions, 0))
    snapshot = line.metrics.snapshot()

    assert snapshot.messages_per_s == pytest.approx(10.0)
    assert snapshot.now_ns == 29 * PERIOD_NS


def test_period_of_rows_is_chosen_by_size() -> None:
    """A large mission is measured less often, so that measuring stays cheap."""

    def every(scenario: Scenario) -> int:
        metrics = measured(_opening_alone(scenario))
        return metrics._every

    assert every(mission()) == 1
    assert every(mission("samples.count=200000")) == 3


def _opening_alone(scenario: Scenario) -> list[Record]:
    setup = WorldSetup.of(scenario, 1)
    return [opening_of(scenario, 1, setup, dict.fromkeys(scenario.robot_ids, ()))]


def test_metrics_file_has_the_rows(tmp_path: Path) -> None:
    """metrics.csv is the rows, one line each, an empty cell where there is no value."""
    scenario = mission("merge=min", "claims=false", "metrics.every=1")
    setup = WorldSetup.of(scenario, 1)
    recording = Recording(scenario, 1, "in-process", tmp_path)
    play(scenario, 1, setup, [recording.observe])
    recording.finish()
    head, *lines = (tmp_path / "metrics.csv").read_text(encoding="utf-8").splitlines()
    rows = recording.metrics.rows
    cells = [line.split(",") for line in lines]
    tight = DensityRow._fields.index("w_ub_tight")

    assert head.split(",") == list(DensityRow._fields)
    assert [line[tight] == "" for line in cells] == [row.w_ub_tight is None for row in rows]
    assert [float(line[4]) for line in cells] == [row.w_ub_paper for row in rows]
