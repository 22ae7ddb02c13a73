"""The figure of quality under loss: what it flies, what it concludes, what it draws."""

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from kantor_fleet.execution.experiment import Case
from kantor_fleet.reproduce import papers
from kantor_fleet.reproduce.claims import MISS, OK, TOLD
from kantor_fleet.reproduce.measured_runs import MeasuredRun, MeasuredRuns, run_all
from kantor_fleet.reproduce.resilience import (
    AIMS,
    DETECTION,
    FINISHING,
    MERGES,
    POINTS,
    ROBOTS,
    SCOURGES,
    Aim,
    Better,
    Estimate,
    Price,
    Scourge,
    part,
    setting,
    values,
)
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import Drop, Partition
from kantor_protocol.scenario.faults.processes import Kill
from support.strategies import mission

DROPPING, PARTED, LOSING = SCOURGES
RUNS = 3


def faults(scourge: Scourge, degree: float, seed: int = 0) -> tuple[Fault, ...]:
    return setting("ledger", DETECTION, scourge, degree, seed).find().faults


def test_every_condition_is_flown_with_the_same_seeds() -> None:
    orders = part(RUNS)

    for aim in AIMS:
        for scourge in SCOURGES:
            for degree in scourge.degrees:
                for merge in MERGES:
                    for seed in range(RUNS):
                        assert seed in orders[setting(merge, aim, scourge, degree, seed)]
    conditions = sum(len(scourge.degrees) - 1 for scourge in SCOURGES) + 1
    assert sum(map(len, orders.values())) == conditions * len(MERGES) * len(AIMS) * RUNS


def test_energy_is_scarce_for_one_aim_and_plenty_for_the_other() -> None:
    scarce, plenty = (setting("min", aim, DROPPING, 0, 0).find() for aim in AIMS)

    assert scarce.steps_per_robot * ROBOTS == pytest.approx(1.05 * POINTS)
    assert plenty.steps_per_robot == POINTS
    assert msgspec.structs.replace(scarce, energy=plenty.energy) == plenty


def test_degrees_are_faults_of_a_scenario() -> None:
    assert faults(DROPPING, 0) == faults(PARTED, 0) == faults(LOSING, 0) == ()
    assert faults(DROPPING, 60) == (Drop(probability=0.6),)
    assert faults(PARTED, 50) == (Partition(shape="halves", from_s=10.0, until_s=30.0),)


@pytest.mark.parametrize("seed", range(5))
def test_one_more_robot_is_lost_and_nothing_else_changes(seed: int) -> None:
    """So that the numbers of lost robots can be compared seed by seed."""
    for fewer, more in zip(LOSING.degrees, LOSING.degrees[1:], strict=False):
        assert faults(LOSING, more, seed)[:-1] == faults(LOSING, fewer, seed)
    four = faults(LOSING, 4, seed)
    assert all(isinstance(fault, Kill) and fault.until_s is None for fault in four)
    assert len({fault.who for fault in four if isinstance(fault, Kill)}) == 4


# Conclusions, from flights that are made up.

_FLOWN = run_all(Case(mission("limit_s=0.5"), 1))


def made_up(outcome: Callable[[str, Aim, float, int], float]) -> MeasuredRuns:
    """Flights of all conditions. outcome: per cent or ticks, by merge, aim, degree and seed."""
    flights: dict[object, list[MeasuredRun]] = {}
    assert _FLOWN.result is not None
    for aim in AIMS:
        for scourge in SCOURGES:
            for degree in scourge.degrees:
                for merge in MERGES:
                    flown = {
                        setting(merge, aim, scourge, degree, seed): seed for seed in range(RUNS)
                    }
                    for made, seed in flown.items():
                        seeds = range(RUNS) if len(flown) == 1 else (seed,)
                        found = [outcome(merge, aim, degree, each) for each in seeds]
                        flights[made] = [
                            MeasuredRun(
                                result=msgspec.structs.replace(
                                    _FLOWN.result,
                                    detection_rate=value / 100.0,
                                    finished_tick=round(value),
                                )
                            )
                            for value in found
                        ]
    return flights  # type: ignore[return-value]


def plain(merge: str, aim: Aim, degree: float, seed: int) -> float:
    """The ledger 10 better; each degree costs 1, each seed has its own luck."""
    sign = 1.0 if aim is DETECTION else -1.0
    return 80.0 + 3.0 * seed - sign * degree + (5.0 if merge == "ledger" else -5.0) * sign


def test_values_are_in_the_order_of_the_seeds() -> None:
    flights = made_up(plain)

    for scourge in SCOURGES:
        found = values(flights, "ledger", DETECTION, scourge, scourge.degrees[-1])
        assert found == pytest.approx([85.0 - scourge.degrees[-1] + 3.0 * i for i in range(RUNS)])


@pytest.mark.parametrize("aim", AIMS)
def test_what_is_better_seed_by_seed_is_better(aim: Aim) -> None:
    """Whatever luck the seeds have."""
    verdict = Better(aim, LOSING).judge("resilience", made_up(plain))

    assert verdict.verdict == OK
    assert verdict.ours.startswith("least +10.0 [+10.0, +10.0]")


@pytest.mark.parametrize("aim", AIMS)
def test_what_is_worse_in_one_degree_is_missed(aim: Aim) -> None:
    def once(merge: str, aim: Aim, degree: float, seed: int) -> float:
        other = {"min": "ledger", "ledger": "min"}[merge]
        return plain(other if degree == 30 else merge, aim, degree, seed)

    assert Better(aim, DROPPING).judge("resilience", made_up(once)).verdict == MISS
    assert Better(aim, PARTED).judge("resilience", made_up(once)).verdict == OK


def test_a_price_is_told() -> None:
    verdict = Price("min", FINISHING, DROPPING).judge("resilience", made_up(plain))

    assert verdict.verdict == TOLD
    assert verdict.ours == "+60.0 [+60.0, +60.0] ticks"


def test_estimates_are_the_same_every_time() -> None:
    sample = np.array([1.0, 2.0, 3.0, 10.0])
    mean, low, high = Estimate.of(sample)

    assert Estimate.of(sample) == (mean, low, high)
    assert 1.0 <= low < mean == 4.0 < high <= 10.0
    assert Estimate.of(np.full(5, 2.5)) == (2.5, 2.5, 2.5)


def test_picture_and_table() -> None:
    """Six diagrams; a row for each degree, a column for each merge and aim."""
    figure, flights = papers.figures("resilience")["resilience"], made_up(plain)
    picture = figure.draw(flights)
    assert figure.table is not None
    table = figure.table(flights)

    assert [len(axes.lines) for axes in picture.axes] == [len(MERGES)] * len(AIMS) * len(SCOURGES)
    assert len(table.shown) == sum(len(scourge.degrees) for scourge in SCOURGES)
    assert len(table.rows) == len(table.shown) * len(MERGES) * len(AIMS)
    assert all(math.isfinite(row["mean"]) for row in table.rows)
    assert table.shown[0]["ledger: detected"] == "88.0 [85.0, 91.0]"
