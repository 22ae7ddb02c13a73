"""The figure of quality under loss: its runs, its verdicts and its drawing."""

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from kantor_fleet.execution.experiment import Case
from kantor_fleet.reproduce import papers
from kantor_fleet.reproduce.claims import MISS, OK, REPORTED
from kantor_fleet.reproduce.measured_runs import MeasuredRun, MeasuredRuns, run_measured
from kantor_fleet.reproduce.resilience import (
    DETECTION,
    FINISHING,
    GRADED_FAULTS,
    MERGES,
    OBJECTIVES,
    POINTS,
    ROBOTS,
    CostOfFault,
    Estimate,
    GradedFault,
    LedgerLead,
    Objective,
    requests,
    setting,
    values,
)
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import Drop, Partition
from kantor_protocol.scenario.faults.processes import Kill
from support.strategies import mission

DROPPING, PARTED, LOSING = GRADED_FAULTS
RUNS = 3


def faults(graded: GradedFault, degree: float, seed: int = 0) -> tuple[Fault, ...]:
    return setting("ledger", DETECTION, graded, degree, seed).find().faults


def test_every_condition_has_the_same_seeds() -> None:
    requested = requests(RUNS)

    for objective in OBJECTIVES:
        for graded in GRADED_FAULTS:
            for degree in graded.degrees:
                for merge in MERGES:
                    for seed in range(RUNS):
                        assert seed in requested[setting(merge, objective, graded, degree, seed)]
    conditions = sum(len(graded.degrees) - 1 for graded in GRADED_FAULTS) + 1
    assert sum(map(len, requested.values())) == conditions * len(MERGES) * len(OBJECTIVES) * RUNS


def test_energy_is_scarce_for_detection_and_plenty_for_finishing() -> None:
    scarce, plenty = (setting("min", objective, DROPPING, 0, 0).find() for objective in OBJECTIVES)

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


# Conclusions, from made-up runs.

_RUN = run_measured(Case(mission("limit_s=0.5"), 1))


def made_up(outcome: Callable[[str, Objective, float, int], float]) -> MeasuredRuns:
    """Runs of all conditions. outcome: per cent or ticks, by merge, objective, degree and seed."""
    measured: dict[object, list[MeasuredRun]] = {}
    assert _RUN.result is not None
    for objective in OBJECTIVES:
        for graded in GRADED_FAULTS:
            for degree in graded.degrees:
                for merge in MERGES:
                    settings = {
                        setting(merge, objective, graded, degree, seed): seed
                        for seed in range(RUNS)
                    }
                    for made, seed in settings.items():
                        seeds = range(RUNS) if len(settings) == 1 else (seed,)
                        found = [outcome(merge, objective, degree, each) for each in seeds]
                        measured[made] = [
                            MeasuredRun(
                                result=msgspec.structs.replace(
                                    _RUN.result,
                                    detection_rate=value / 100.0,
                                    finished_tick=round(value),
                                )
                            )
                            for value in found
                        ]
    return measured  # type: ignore[return-value]


def plain(merge: str, objective: Objective, degree: float, seed: int) -> float:
    """The ledger 10 better; each degree costs 1, each seed has its own offset."""
    sign = 1.0 if objective is DETECTION else -1.0
    return 80.0 + 3.0 * seed - sign * degree + (5.0 if merge == "ledger" else -5.0) * sign


def test_values_are_in_the_order_of_the_seeds() -> None:
    measured = made_up(plain)

    for graded in GRADED_FAULTS:
        found = values(measured, "ledger", DETECTION, graded, graded.degrees[-1])
        assert found == pytest.approx([85.0 - graded.degrees[-1] + 3.0 * i for i in range(RUNS)])


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_lead_in_every_seed_is_met(objective: Objective) -> None:
    """Whatever the offsets of the seeds."""
    verdict = LedgerLead(objective, LOSING).judge("resilience", made_up(plain))

    assert verdict.verdict == OK
    assert verdict.ours.startswith("least +10.0 [+10.0, +10.0]")


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_lead_that_one_degree_lacks_is_missed(objective: Objective) -> None:
    def once(merge: str, objective: Objective, degree: float, seed: int) -> float:
        other = {"min": "ledger", "ledger": "min"}[merge]
        return plain(other if degree == 30 else merge, objective, degree, seed)

    assert LedgerLead(objective, DROPPING).judge("resilience", made_up(once)).verdict == MISS
    assert LedgerLead(objective, PARTED).judge("resilience", made_up(once)).verdict == OK


def test_the_cost_of_a_fault_is_reported() -> None:
    verdict = CostOfFault("min", FINISHING, DROPPING).judge("resilience", made_up(plain))

    assert verdict.verdict == REPORTED
    assert verdict.ours == "+60.0 [+60.0, +60.0] ticks"


def test_estimates_are_the_same_every_time() -> None:
    sample = np.array([1.0, 2.0, 3.0, 10.0])
    mean, low, high = Estimate.of(sample)

    assert Estimate.of(sample) == (mean, low, high)
    assert 1.0 <= low < mean == 4.0 < high <= 10.0
    assert Estimate.of(np.full(5, 2.5)) == (2.5, 2.5, 2.5)


def test_picture_and_table() -> None:
    """Six diagrams; a row for each degree, a column for each merge and objective."""
    figure, measured = papers.figures("resilience")["resilience"], made_up(plain)
    picture = figure.draw(measured)
    assert figure.table is not None
    table = figure.table(measured)

    assert [len(axes.lines) for axes in picture.axes] == [len(MERGES)] * len(OBJECTIVES) * len(
        GRADED_FAULTS
    )
    assert len(table.shown) == sum(len(graded.degrees) for graded in GRADED_FAULTS)
    assert len(table.rows) == len(table.shown) * len(MERGES) * len(OBJECTIVES)
    assert all(math.isfinite(row["mean"]) for row in table.rows)
    assert table.shown[0]["ledger: detected"] == "88.0 [85.0, 91.0]"
