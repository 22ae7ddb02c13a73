"""`kantor reproduce`: verdicts that can fail, and figures, numbers and a table from one command."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import pytest
from PIL import Image

from kantor_fleet.reproduce.claims import (
    MISS,
    OK,
    UNMATCHED,
    MedianInBand,
    MedianRatio,
    NarrowestSpread,
    PairedLead,
    RareShare,
    WideRange,
    interval,
    quartiles,
)
from kantor_fleet.reproduce.kabir_lee import FIGURES, drop_at_contact, loosest
from kantor_fleet.reproduce.measured_runs import MeasuredRun, Setting
from kantor_worldsim.observers.metrics.density import DensityRow
from support.claims import number, runs_of
from support.files import rows_of

if TYPE_CHECKING:
    from support.processes.command import Kantor

HERE, THERE = Setting("here"), Setting("there")


def test_a_median_must_lie_in_its_band() -> None:
    """Its ends belong to it; one run outside the band does not matter, the middle one does."""

    def verdict(*values: float, why: str = "") -> str:
        claim = MedianInBand("it", HERE, "2", 1.0, 3.0, number, why=why)
        return claim.judge("fig0", {HERE: runs_of(*values)}).verdict

    assert [verdict(*values) for values in ((1, 3, 99), (3, 3, 3), (1, 1, 1))] == [OK] * 3
    assert [verdict(*values) for values in ((0, 0.9, 3), (1, 3.1, 99))] == [MISS] * 2
    assert verdict(2, 2, why="the published figure is impossible") == UNMATCHED
    assert verdict(4, 4, why="the published figure is impossible") == MISS


def test_a_median_is_printed_with_its_quartiles_and_its_band() -> None:
    line = MedianInBand("it", HERE, "2", 1.0, math.inf, number, 1, " %").judge(
        "fig0", {HERE: runs_of(1, 2, 3, 4, 5)}
    )

    assert (line.ours, line.reading) == ("3.0 [2.0, 4.0] %", "≥ 1 %")


def test_the_narrowest_spread_must_be_the_narrowest() -> None:
    claim = NarrowestSpread("it", HERE, (THERE,), "narrower", number, "")

    wide, narrow = runs_of(0, 10, 20), runs_of(100, 101, 102)
    assert claim.judge("fig0", {HERE: narrow, THERE: wide}).verdict == OK
    assert claim.judge("fig0", {HERE: wide, THERE: narrow}).verdict == MISS


@pytest.mark.parametrize(
    ("upper", "lower", "apart", "verdict"),
    [
        ((15, 16, 17), (1, 2, 3), True, OK),
        ((5, 6, 7), (4.9, 5.9, 6.9), False, OK),  # seed by seed ahead
        ((5, 6, 7), (4.9, 5.9, 6.9), True, MISS),  # but the intervals overlap
        ((5, 6, 7), (6, 5, 8), False, MISS),
        ((1, 2, 3), (5, 6, 7), True, MISS),
    ],
)
def test_a_lead_needs_pairs_and_if_asked_separate_intervals(
    upper: Sequence[float], lower: Sequence[float], *, apart: bool, verdict: str
) -> None:
    claim = PairedLead("it", HERE, THERE, "ahead", "", number, "", apart=apart)

    line = claim.judge("fig0", {HERE: runs_of(*upper), THERE: runs_of(*lower)})

    assert line.verdict == verdict


def test_a_reading_that_is_not_significant_accepts_either_sign() -> None:
    claim = PairedLead("it", HERE, THERE, "ahead", "", number, "", sure=False)

    assert claim.judge("fig0", {HERE: runs_of(1, 2), THERE: runs_of(2, 1)}).verdict == OK


def test_a_ratio_of_medians_is_reported_and_not_judged() -> None:
    claim = MedianRatio("it", HERE, THERE, "much less", number, "it depends")

    line = claim.judge("fig0", {HERE: runs_of(1, 1), THERE: runs_of(2, 2)})

    assert (line.verdict, line.why) == (UNMATCHED, "it depends")
    assert "0.50 times" in line.ours


def test_a_range_goes_from_the_lowest_to_the_highest() -> None:
    claim = WideRange("it", (HERE, THERE), "", 5.0, number, " %")

    far = claim.judge("fig0", {HERE: runs_of(70), THERE: runs_of(75)})
    assert (far.verdict, far.ours) == (OK, "70.0 to 75.0 % over 2 starts")
    assert claim.judge("fig0", {HERE: runs_of(70), THERE: runs_of(74.9)}).verdict == MISS


def test_a_share_counts_runs() -> None:
    claim = RareShare("it", HERE, "", 0.25, lambda run: run.robots_s > 10)

    assert claim.judge("fig0", {HERE: runs_of(1, 2, 3, 11)}).verdict == OK
    assert claim.judge("fig0", {HERE: runs_of(1, 2, 11, 11)}).verdict == MISS


def test_an_interval_is_that_of_student() -> None:
    """Mean 2, standard error 1/sqrt(3), two degrees of freedom: t = 4.303."""
    assert interval([1.0, 2.0, 3.0]) == pytest.approx((2.0, 4.3026527 / math.sqrt(3.0)))
    assert quartiles([7.0]) == (7.0, 7.0, 7.0)


def test_measures_read_the_rows(row: DensityRow) -> None:
    """The fall until both have heard; the bound over the exact distance at its worst."""
    bounds = {9: 100.0, 10: 90.0, 11: 70.0, 12: 69.0, 40: 1.0}
    rows = [row._replace(tick=tick, w_ub_instant=bound) for tick, bound in bounds.items()]
    exact = [row._replace(w_ub_tight=tight, w1_exact=1.0) for tight in (1.5, 2.5, None, 2.0)]
    result = FakeResult(first_contact_tick=10)

    assert drop_at_contact(MeasuredRun(rows=tuple(rows), result=result)) == pytest.approx(30.0)  # type: ignore[arg-type]
    assert drop_at_contact(MeasuredRun(rows=tuple(rows), result=FakeResult(None))) == 0.0  # type: ignore[arg-type]
    assert loosest(MeasuredRun(rows=(*exact, row))) == 2.5


class FakeResult:
    """As much of a result as a measure reads."""

    def __init__(self, first_contact_tick: int | None) -> None:
        self.first_contact_tick = first_contact_tick


@pytest.fixture
def row() -> DensityRow:
    return DensityRow(0, 0.0, 0, 0, 1.0, None, 1.0, 1.0, 0.0, 0, 0, 0, None, None)


def test_every_setting_of_every_figure_is_a_scenario_that_can_be_run() -> None:
    for figure in FIGURES.values():
        for setting in {setting for claim in figure.claims for setting in claim.settings}:
            assert setting.find().planner.name in {"transport", "spectral"}


def test_a_figure_comes_with_its_numbers_and_its_verdicts(kantor: "Kantor") -> None:
    """`kantor reproduce fig8`: PNG, PDF, CSV and the table; as often as asked for."""
    done = kantor("reproduce", "fig8", "--runs", 2, "--jobs", 2, "--out", "figures")
    folder = kantor.folder / "figures"

    assert done.code in (0, 1), done.err  # two runs may miss a band
    assert {path.name for path in folder.iterdir()} == {
        "fig8.png",
        "fig8.pdf",
        "fig8.csv",
        "verdicts.csv",
    }
    with Image.open(folder / "fig8.png") as image:
        assert image.width > 1000
    assert (folder / "fig8.pdf").read_bytes().startswith(b"%PDF")
    runs = rows_of(folder / "fig8.csv")
    assert [int(run["seed"]) for run in runs] == [0, 1, 0, 1]
    assert all(0 < int(run["detected"]) <= 500 for run in runs)
    verdicts = rows_of(folder / "verdicts.csv")
    assert {line["figure"] for line in verdicts} == {"fig8"}
    assert done.code == (1 if any(line["verdict"] == MISS for line in verdicts) else 0)
    for line in verdicts:
        assert line["ours"].split()[0] in done.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--runs", 1), "--runs 1: give at least 2, an interval needs them"),
        (("--jobs", 0), "--jobs 0: give at least 1"),
    ],
)
def test_what_cannot_be_run_is_refused(
    kantor: "Kantor", arguments: tuple[object, ...], message: str
) -> None:
    done = kantor("reproduce", "fig8", *arguments, "--out", "figures")

    assert (done.code, done.err) == (2, f"kantor: {message}\n")
    assert not (kantor.folder / "figures").exists()
