"""Bounds and masses of a density mission: by hand on a line, and at the start of any mission."""

from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_worldsim.observers.metrics.density import DensityRow
from kantor_worldsim.record.records import Opening, Record
from kantor_worldsim.world.world import WorldSetup
from support.line_mission import LineMission, measured, result_of
from support.records import Play
from support.strategies import mission

# Two samples on a line, by hand.


def bounds(rows: Sequence[DensityRow]) -> list[tuple[float, float | None, float]]:
    return [(row.w_ub_paper, row.w_ub_tight, row.w_ub_instant) for row in rows]


def test_bounds_by_hand_without_a_supervisor() -> None:
    """Eq. 12 over the team: each robot's own vector counts whole, or its share of the true rest.

    Start: each robot has 10 m and 30 m to half the mass each, 20 together. Tick 1: both go 5 m and
    ship a quarter of the mass over 5 m. Each still counts the other's sample as full. Tick 2: both
    stand on their samples.
    """
    line = LineMission()
    line.play(line.step_record("r1", 5.0, 0, 1), line.step_record("r2", 35.0, 1, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 30.0, 1, 0))

    # pending at 1: 1/4 * 5 + 2/4 * 25 for each; of the true rest: 1/4 * 5 for each
    # pending at 2: 2/4 * 20 for each; of the true rest: nothing
    assert bounds(line.rows()) == [
        (40.0, 10.0, 40.0),
        (2.5 + 27.5, 2.5 + 2.5, 2.5 + 27.5),
        (2.5 + 20.0, 2.5, 20.0),
    ]


def test_bounds_by_hand_with_a_supervisor() -> None:
    """Eq. 11: every robot counts the common weights, which are the least of all views."""
    line = LineMission("coordination=centralized")
    line.play(line.step_record("r1", 5.0, 0, 1), line.step_record("r2", 35.0, 1, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 30.0, 1, 0))

    assert bounds(line.rows()) == [
        (40.0, 10.0, 40.0),
        (2.5 + 15.0, 2.5 + 2.5, 2.5 + 15.0),
        (2.5, 2.5, 0.0),
    ]


def test_tight_bound_ends_when_a_sample_is_filled_twice() -> None:
    """From the tick on in which more is shipped to a sample than it takes, there is none."""
    line = LineMission()
    line.play(line.step_record("r1", 10.0, 0, 1), line.step_record("r2", 30.0, 1, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 20.0, 0, 1))
    line.play(line.step_record("r1", 20.0, 1, 1), line.step_record("r2", 10.0, 1, 0))
    rows = line.rows()

    assert [row.w_ub_tight is None for row in rows] == [False, False, True, True]
    assert [row.mass_double_counted for row in rows] == [0.0, 0.0, 0.25, 0.5]
    assert [row.mass_left for row in rows] == [1.0, 0.5, 0.25, 0.0]


def test_ledger_counts_what_was_really_shipped() -> None:
    """With the ledger the mass left is the truth, whatever the views hold."""
    line = LineMission("merge=ledger")
    line.play(line.step_record("r1", 10.0, 0, 1), line.step_record("r2", 10.0, 0, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 30.0, 1, 1))
    rows = line.rows()

    assert [row.mass_left for row in rows] == [1.0, 0.5, 0.25]
    assert [row.mass_double_counted for row in rows] == [0.0, 0.0, 0.25]


def test_mass_left_is_that_of_the_least_view_even_if_views_rise() -> None:
    """A record that is not sound is measured as it stands: the minimum over all views, sample by sample."""
    line = LineMission()
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 10.0, 0, 1))
    line.play(line.step_record("r1", 10.0, 0, 2), line.step_record("r2", 10.0, 1, 1))
    line.play(line.step_record("r2", 10.0, 0, 2))

    assert [row.mass_left for row in line.rows()] == [1.0, 0.5, 0.5, 0.75]


@pytest.mark.parametrize("violation", ["step", "energy", "units"])
def test_refused_spending_counts_for_nothing(violation: str) -> None:
    """Spending that world-sim refused is neither shipped nor energy."""
    line = LineMission()
    line.play(
        line.step_record("r1", 0.0, 0, 1, (violation,)),
        line.step_record("r2", 40.0, 1, 1, ("speed",)),
    )
    rows = line.rows()

    assert rows[-1].energy_spent == 1
    assert rows[-1].w_ub_paper == 2.5 + 0.25 * (10 + 2 * 30) + 0.25 * (10 + 2 * 30)
    assert result_of(line.metrics).violations == 2


# Where samples are.


def test_cost_is_taken_where_the_sample_then_is() -> None:
    """Samples that walk are shipped to, and counted, where they are at the time of the step."""
    records = list(_walking_run())
    opening = records[0]
    assert isinstance(opening, Opening)
    rows = measured(records).rows

    assert rows[0].w_ub_paper == pytest.approx(plain_bound(opening))
    assert rows[-1].w_ub_paper < 0.7 * rows[0].w_ub_paper


def _walking_run() -> Iterable[Record]:
    scenario = mission("samples.diffusion_m=3.0", "metrics.every=1")
    records: list[Record] = []
    setup = WorldSetup.of(scenario, 1)
    play(scenario, 1, setup, [records.append])
    return records


# The start.


def plain_bound(opening: Opening) -> float:
    """Eq. 6, 11 and 12 at t = 0: all mass, over its distance to every robot, summed."""
    setup = opening.setup
    way_m = np.linalg.norm(setup.starts_m[:, None] - setup.samples_m[None], axis=2)
    return float(way_m.sum() / setup.samples_m.shape[0])


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
@pytest.mark.parametrize("merge", [("merge=ledger",), ("merge=min", "claims=false")])
def test_bound_at_the_start_is_the_plain_formula(
    played: Play, coordination: str, merge: tuple[str, ...]
) -> None:
    """W_UB(0) = sum over robots and samples of n_0 times the distance, for every variant."""
    records = played(f"coordination={coordination}", *merge)
    opening = records[0]
    assert isinstance(opening, Opening)
    first = measured(records).rows[0]

    assert first.w_ub_paper == pytest.approx(plain_bound(opening), rel=1e-12)
    assert first.w_ub_instant == first.w_ub_paper
    assert first.w_ub_tight is not None
    assert first.w_ub_tight <= first.w_ub_paper / 3.0 * (1.0 + 1e-12)
