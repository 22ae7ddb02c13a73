"""`kantor reproduce` of papers that explore a map: ratios, even parts, kept runs, pictures."""

import itertools
import math
import signal
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure as Picture
from PIL import Image

from kantor_fleet.execution.experiment import Case, Outcome
from kantor_fleet.execution.pools import Pool
from kantor_fleet.exits import Exit
from kantor_fleet.reproduce import burgard, explored, kabir_lee, kme, papers
from kantor_fleet.reproduce.claims import (
    MISS,
    OK,
    REPORTED,
    UNMATCHED,
    GeometricMeanRatio,
    IdenticalRuns,
    LowerThroughout,
    LowestMean,
    MeanRatio,
    geometric,
    mean_ratio,
    paired_ratios,
    text_of_ratio,
)
from kantor_fleet.reproduce.figure import PaperFigure
from kantor_fleet.reproduce.measured_runs import MeasuredRun, MeasuredRuns, Moment, Setting
from kantor_fleet.reproduce.measures import finished, map_row, wtv_final
from kantor_fleet.reproduce.run import reproduce
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey
from kantor_protocol.scenario.schema import MAP_PLANNERS
from kantor_worldsim.observers.metrics.result import (
    Bounds,
    ByRegions,
    BytesPerRobotTick,
    MapResult,
    Result,
)
from support.claims import number, runs_of
from support.files import rows_of, wait_until
from support.limits import EVENT_LIMIT_S
from support.strategies import examples

if TYPE_CHECKING:
    from support.processes.command import Kantor

HERE, THERE, FAR = Setting("here"), Setting("there"), Setting("far")
POSITIVE = st.floats(min_value=1e-3, max_value=1e6)


# Claims


def test_a_ratio_of_means_must_lie_in_its_band_and_needs_none() -> None:
    """The band's ends belong to it; where the paper's number is out of reach the verdict is UNMATCHED."""

    def verdict(*over: float, low: float = -math.inf, high: float = math.inf, why: str = "") -> str:
        claim = MeanRatio("it", HERE, THERE, "", "", number, low, high, why)
        return claim.judge("fig0", {HERE: runs_of(*over), THERE: runs_of(2, 6)}).verdict

    assert verdict(2, 4, high=0.75) == OK
    assert verdict(2, 4.1, high=0.75) == MISS
    assert verdict(2, 4, low=0.8, high=1.2) == MISS
    assert verdict(6, 2, low=0.8, high=1.2, why="it depends") == UNMATCHED
    assert verdict(6, 60) == REPORTED


def test_a_ratio_of_means_comes_with_its_interval() -> None:
    """Whole starts are drawn again, so that what both share does not widen the interval."""
    claim = MeanRatio("it", HERE, THERE, "", "≤ 1", number, high=1.0)

    line = claim.judge("fig0", {HERE: runs_of(1, 10, 100), THERE: runs_of(2, 20, 200)})

    assert (line.ours, line.verdict) == ("0.50 [0.50, 0.50]", OK)


@given(st.lists(st.tuples(POSITIVE, POSITIVE), min_size=2, max_size=8), st.floats(0.1, 10.0))
@examples(25)
def test_an_interval_of_a_ratio_scales_with_it(
    pairs: list[tuple[float, float]], factor: float
) -> None:
    """It is the same every time, and in whatever unit."""
    over, under = zip(*pairs, strict=True)

    ratio, low, high = mean_ratio(over, under, 200)

    scaled = mean_ratio([factor * value for value in over], under, 200)
    assert low <= high
    assert scaled == pytest.approx((factor * ratio, factor * low, factor * high))


def test_what_must_be_the_same_is_so_in_every_run() -> None:
    claim = IdenticalRuns("it", HERE, THERE, "", (number,))

    assert claim.judge("", {HERE: runs_of(1, 2), THERE: runs_of(1, 2)}).verdict == OK
    line = claim.judge("", {HERE: runs_of(1, 2), THERE: runs_of(1, 2.5)})
    assert (line.verdict, line.ours) == (MISS, "1 of 2 runs the same")


@pytest.mark.parametrize(
    ("there", "far", "above", "verdict"),
    [
        (5, 9, ("there",), OK),
        (5, 1, ("there",), UNMATCHED),  # the reading does not have it below the third
        (1, 9, ("there",), MISS),
        (1, 9, (), REPORTED),
    ],
)
def test_the_lowest_lies_below_those_that_a_reading_has_above(
    there: float, far: float, above: tuple[str, ...], verdict: str
) -> None:
    named = (("here", HERE), ("there", THERE), ("far", FAR))
    claim = LowestMean("it", named, "", number, above, "it depends")

    line = claim.judge("fig0", {HERE: runs_of(2, 4), THERE: runs_of(there), FAR: runs_of(far)})

    assert line.verdict == verdict
    assert line.why == ("" if min(there, far) > 3 else "it depends")


def test_geometric_ratios_use_the_runs_of_both_settings() -> None:
    """A part of the configurations has no runs of some settings; with one run there is no interval."""
    claim = GeometricMeanRatio("it", (HERE, FAR), (THERE, FAR), "", "", number, 0.5)
    found = {HERE: runs_of(1, 4), THERE: runs_of(2, 8)}

    line = claim.judge("fig0", found)

    assert (line.verdict, line.ours) == (OK, "0.50 x÷ 1.00 (n = 2)")
    assert claim._replace(most=0.4).judge("fig0", found).verdict == MISS
    assert claim._replace(most=math.inf).judge("fig0", found).verdict == REPORTED
    assert claim.judge("fig0", {}).ours == "no runs"
    assert text_of_ratio(*geometric([2.0])) == "2.00"


@given(st.lists(POSITIVE, min_size=2, max_size=20))
@examples(25)
def test_inverse_ratios_have_the_inverse_geometric_mean(values: list[float]) -> None:
    """The ratio of KME to the others and its inverse have inverse means and equal factors."""
    mean, factor = geometric(values)

    assert geometric([1.0 / value for value in values]) == pytest.approx((1.0 / mean, factor))
    assert min(values) <= mean * (1 + 1e-9)
    assert mean <= max(values) * (1 + 1e-9)


def test_lower_is_judged_setting_by_setting_beyond_the_interval() -> None:
    claim = LowerThroughout("it", (("one", (HERE, FAR), (THERE, FAR)),), "", number)

    def verdict(here: Iterable[float], there: Iterable[float]) -> str:
        return claim.judge("", {HERE: runs_of(*here), THERE: runs_of(*there)}).verdict

    assert verdict((1, 2, 3), (4,)) == OK
    assert verdict((5,), (1, 2, 3)) == MISS
    both = {HERE: runs_of(5, 6), THERE: runs_of(5, 5.5), FAR: runs_of(2)}
    assert claim.judge("", both).verdict == OK  # above, but within its interval


# Configurations


def test_configurations_are_those_of_the_paper() -> None:
    """V-C: 3 maps, 2 kinds of starts, 2 to 8 robots, 15 spots: 630, each once."""
    assert kme.CONFIGURATIONS == 630
    assert set(kme.configurations()) == set(
        itertools.starmap(
            kme.Configuration,
            itertools.product(kme.MAPS, kme.STARTS, kme.TEAMS, range(kme.SPOTS)),
        )
    )


@given(st.integers(0, 630 - 42))
@examples(50)
def test_any_beginning_of_the_configurations_is_balanced(first: int) -> None:
    some = kme.configurations()[first : first + 42]

    assert len({(each.map, each.starts) for each in some[:6]}) == 6
    assert {each.robots for each in some[:7]} == set(kme.TEAMS)
    assert len({(each.map, each.starts, each.robots) for each in some}) == 42


def test_requested_runs_have_every_planner_under_the_same_conditions() -> None:
    requested = kme.requests(24)

    assert sum(map(len, requested.values())) == 4 * 24
    for place, starts, robots, spot in kme.configurations()[:24]:
        for planner in kme.PLANNERS:
            assert spot in requested[kme.setting(planner, place, starts, robots)]
    wider = kme.requests(120)
    assert all(set(seeds) <= set(wider[setting]) for setting, seeds in requested.items())
    assert sum(map(len, kme.requests(10_000).values())) == 4 * 630


def test_robots_that_start_together_start_at_every_spot() -> None:
    """Fifteen runs of a setting are the fifteen set-ups of the paper."""
    setting = kme.setting(kme.KME, "unstructured", "together", 4)

    assert setting.find().starts.spots == kme.SPOTS
    assert kme.requests(630)[setting] == list(range(kme.SPOTS))


@pytest.mark.parametrize("name", [*burgard.FIGURES, *kme.FIGURES])
def test_every_setting_of_a_figure_is_a_map_that_can_be_run(name: str) -> None:
    figure = papers.FIGURES[name]
    requested = figure.requests()

    assert {setting for claim in figure.claims for setting in claim.settings} <= requested.keys()
    scenarios = [setting.find() for setting in requested]
    assert {scenario.planner.name for scenario in scenarios} <= MAP_PLANNERS
    assert len(set(scenarios)) == len(scenarios)  # runs are distinguished by their scenarios


def test_all_stands_for_the_first_paper() -> None:
    assert papers.figures("all") == kabir_lee.FIGURES
    assert list(papers.figures("kme-fig7")) == ["kme-fig7"]


def test_readings_differ_in_what_the_paper_leaves_open() -> None:
    """With one robot the whole team is the robot, so that each reading starts from one bar."""
    for reading in burgard.READINGS:
        one, other = (
            reading.setting(2, coordinated=coordinated).find() for coordinated in (True, False)
        )
        assert one.starts == other.starts
        assert (one.planner.coordinated, other.planner.coordinated) == (True, False)
        assert (one.centralized, one.radio.range_m) == (True, math.inf)
    assert len({burgard.READINGS[i].setting(2, coordinated=False) for i in range(4)}) == 4


# Pictures, from made-up runs


def map_result(**numbers: float) -> MapResult:
    """A map explored, with some numbers; the others are 0."""
    zeros = dict.fromkeys(MapResult.__struct_fields__, 0)
    by_regions = ByRegions(*[numbers.pop("regions", 1.0)] * 6)
    waits = dict.fromkeys(("wtv_final", "wtv_mean", "epv_final", "epv_mean"), by_regions)
    return MapResult(**zeros | waits | numbers)  # type: ignore[arg-type]


class FakeResult:
    """As much of a result as figures read."""

    def __init__(self, seed: int, tick: int, regions: float) -> None:
        self.seed, self.ticks, self.finished_tick = seed, tick, tick
        self.map = map_result(regions=regions, distance_m=float(tick), explored=1.0)


def made_up(setting: Setting, seed: int) -> MeasuredRun:
    """What might come of a run: the more robots the sooner, the later the planner the longer."""
    scenario = setting.find()
    planner = sorted(MAP_PLANNERS).index(scenario.planner.name)
    tick = 1000 // scenario.robots.count + 100 * planner + seed
    tick += 50 * (not scenario.planner.coordinated) * (scenario.robots.count > 1)
    course = tuple(Moment(t, 10.0 * t, 100.0 - t) for t in (*range(0, tick, 10), tick))
    result = FakeResult(seed, tick, 1.0 + tick)
    return MeasuredRun(result=result, course=course)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def drawn() -> Callable[[str], tuple[MeasuredRuns, Picture]]:
    def draw(name: str) -> tuple[MeasuredRuns, Picture]:
        figure = papers.FIGURES[name]._replace(runs=42 if name == "kme-all" else 3)
        found = {
            setting: [made_up(setting, seed) for seed in seeds]
            for setting, seeds in figure.requests().items()
        }
        return found, figure.draw(found)

    return draw


def test_bars_are_means_in_seconds(drawn: Callable[[str], tuple[MeasuredRuns, Picture]]) -> None:
    """Figure 8 of Burgard et al.: a diagram for each reading, beside the office."""
    _, picture = drawn("burgard-fig8")

    office, bars = picture.subfigs
    assert office.axes[0].get_title(loc="left").startswith("27 x 20 m")
    assert [axes.get_title(loc="left")[:3] for axes in bars.axes] == ["(A)", "(B)", "(C)", "(D)"]
    heights = [patch.get_height() for patch in bars.axes[0].patches]  # type: ignore[attr-defined]
    assert heights[0] == pytest.approx(0.2 * (1000 + 1))  # three seeds, a fifth of a second a tick
    assert heights[0] == heights[3]
    assert heights[1] > heights[4]


@pytest.mark.parametrize(("name", "lines"), [("kme-fig6", 6), ("kme-fig7", 4), ("kme-fig8", 4)])
def test_curves_end_where_the_last_run_ends(
    name: str, lines: int, drawn: Callable[[str], tuple[MeasuredRuns, Picture]]
) -> None:
    found, picture = drawn(name)

    assert len(picture.axes) == 4
    for axes, robots in zip(picture.axes, (2, 4, 6, 8), strict=True):
        assert f"{robots} robots" in axes.get_title(loc="left")
        assert len(axes.lines) == 2 * lines  # and a dot each
        starts = "together" if name == "kme-fig6" else "separate"
        runs = found[kme.setting(kme.KME, "unstructured", starts, robots)]
        assert axes.lines[0].get_xdata()[-1] == max(run.course[-1].tick for run in runs)  # type: ignore[index]


def test_a_run_that_has_ended_stays_where_it_ended() -> None:
    """As the paper's curves: where one terminates is the final variance."""
    short = [Moment(0, 0.0, 8.0), Moment(10, 4.0, 6.0)]
    long = [Moment(0, 0.0, 8.0), Moment(10, 2.0, 6.0), Moment(20, 6.0, 2.0), Moment(23, 8.0, 0.0)]

    ticks, mean = explored.mean_curve([short, long], "wtv")

    assert ticks.tolist() == [0.0, 10.0, 20.0, 23.0]
    np.testing.assert_allclose(mean, [0.0, 3.0, 5.0, 6.0])


def test_the_table_has_every_measure_by_number_of_robots(
    drawn: Callable[[str], tuple[MeasuredRuns, Picture]],
) -> None:
    found, picture = drawn("kme-all")

    table = kme.ratios(found)

    assert "42 of 630 configurations" in table.title
    assert [axes.get_title(loc="left") for axes in picture.axes] == [
        f"({letter}) {measure}" for letter, measure in zip("abcd", kme.MEASURES, strict=True)
    ]
    assert len(table.shown) == 4 * 4  # three others and how often KME is the lowest
    whole = [
        row
        for row in table.rows
        if (row["measure"], row["against"], row["robots"]) == ("final WTV", "Yamauchi", "4 to 8")
    ]
    pairs = paired_ratios(found, kme.group(kme.KME), kme.group(kme.YAMAUCHI), wtv_final)
    assert [row["ratio"] for row in whole] == [pytest.approx(geometric(pairs)[0])]
    assert whole[0]["configurations"] == 5 * 6


def test_a_row_of_a_run_has_flat_columns() -> None:
    row = map_row(finished_run())

    assert (row["finished_tick"], row["explored"]) == (7, 0.5)
    assert row["wtv_final_r8"] == 3.0


def finished_run(seed: int = 0, tick: int = 7, regions: float = 3.0) -> Result:
    """A result of a map, as it would be read back."""
    return Result(
        scenario="made-up",
        seed=seed,
        exchange="in-process",
        clock="concurrent",
        planner="kmeans",
        merge="ledger",
        claims=True,
        robots=2,
        ticks=tick,
        finished_tick=tick,
        first_contact_tick=None,
        detected=0,
        targets=0,
        detection_rate=None,
        w_ub_start=0.0,
        w_ub=Bounds(0.0, None, 0.0),
        w1_exact=None,
        energy_spent=0,
        energy_total=0,
        mass_left=0.5,
        mass_double_counted=0.0,
        bytes_per_robot_tick=BytesPerRobotTick(0.0, 0.0),
        deliveries=0,
        drops=0,
        out_of_range_refused=0,
        messages_refused=0,
        absences=0,
        ended="done",
        record="whole",
        violations=0,
        complaints=(),
        digest="",
        wall_s=0.0,
        map=map_result(explored=0.5, regions=regions),
    )


# The command


def kept(folder: Path) -> int:
    """Runs in the journal."""
    try:
        return (folder / "runs.jsonl").read_bytes().count(b"\n") - 1
    except FileNotFoundError:
        return 0


def test_kept_runs_read_back_as_they_were(tmp_path: Path) -> None:
    key, run = RunKey("a", "b", 3, exact=False), MeasuredRun(course=(Moment(0, 1.5, 0.1),))
    with RunsJournal(tmp_path / "runs.jsonl", MeasuredRun) as journal:
        journal.add(key, run)

    with RunsJournal(tmp_path / "runs.jsonl", MeasuredRun) as journal:
        assert journal.outcomes == {key: run}
    with RunsJournal(tmp_path / "runs.jsonl") as journal:  # a sweep reads what it knows
        assert journal.outcomes == {key: Outcome()}


def simple_figure() -> PaperFigure:
    """Two runs of one setting."""
    setting = kme.setting(kme.KME, "blank", "together", 2)
    claim = MeanRatio("it", setting, setting, "", "", finished)
    return PaperFigure("a figure", 2, (claim,), lambda _measured: Picture(), map_row, kept=True)


def pool_of(*runs_by_seed: MeasuredRun) -> Callable[[Iterable[Case]], Pool]:
    """A pool that runs nothing and has the outcomes."""

    def start(cases: Iterable[Case]) -> Pool:
        for case in cases:
            yield None
            yield case, runs_by_seed[case.seed]

    return start


def test_a_run_that_broke_a_rule_counts_and_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = (
        MeasuredRun(result=finished_run(0)),
        MeasuredRun(result=finished_run(1), failed="too fast"),
    )

    code = reproduce({"a": simple_figure()}, None, pool_of(good, bad), tmp_path)

    assert code == Exit.NOT_MET
    assert "1 runs broke a rule and are counted nevertheless: too fast" in capsys.readouterr().out
    assert len(rows_of(tmp_path / "a.csv")) == 2
    nothing = pool_of()  # both are kept
    assert reproduce({"a": simple_figure()}, None, nothing, tmp_path) == Exit.NOT_MET


def test_a_folder_keeps_the_verdicts_of_its_figures(tmp_path: Path) -> None:
    """Those of a figure that is drawn anew are replaced, whichever command drew it."""
    pool = pool_of(*(MeasuredRun(result=finished_run(seed)) for seed in (0, 1)))

    for name in ("a", "b", "a"):
        reproduce({name: simple_figure()}, None, pool, tmp_path)

    assert [line["figure"] for line in rows_of(tmp_path / "verdicts.csv")] == ["b", "a"]


def test_a_run_without_a_result_is_run_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, none = MeasuredRun(result=finished_run(0)), MeasuredRun(failed="its worker died: SIGKILL")

    code = reproduce({"a": simple_figure()}, None, pool_of(good, none), tmp_path)

    assert code == Exit.NOT_MET
    assert "1 runs failed; nothing was written; the same command runs" in capsys.readouterr().err
    assert not (tmp_path / "a.csv").exists()
    again = pool_of(none, MeasuredRun(result=finished_run(1)))  # seed 0 is kept
    assert reproduce({"a": simple_figure()}, None, again, tmp_path) == Exit.DONE


def test_an_interrupted_figure_resumes_where_it_was_stopped(kantor: "Kantor") -> None:
    """`kantor reproduce kme-all`: what is finished is kept; a narrower one then runs nothing."""
    folder = kantor.folder / "figures"
    command = ("reproduce", "kme-all", "--runs", 3, "--jobs", 1, "--out", "figures")
    running = kantor.start(*command)
    wait_until(lambda: kept(folder) >= 2)
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=EVENT_LIMIT_S)
    before = kept(folder)

    assert running.returncode == 130
    assert f"{before} of 12 runs are done; the same command goes on from there" in err
    assert {path.name for path in folder.iterdir()} == {"runs.jsonl"}

    done = kantor(*command)
    assert done.code in (0, 1), done.err  # so few runs may miss a band
    assert kept(folder) == 12
    assert {path.name for path in folder.iterdir()} == {
        *(f"kme-all.{suffix}" for suffix in ("png", "pdf", "csv")),
        *("kme-all-table.csv", "verdicts.csv", "runs.jsonl"),
    }
    with Image.open(folder / "kme-all.png") as image:
        assert image.width > 1000
    runs = rows_of(folder / "kme-all.csv")
    assert len(runs) == 12
    assert all(float(run["explored"]) > 0.99 for run in runs)
    verdicts = rows_of(folder / "verdicts.csv")
    assert done.code == (1 if any(line["verdict"] == MISS for line in verdicts) else 0)

    again = kantor(*command)
    assert kept(folder) == 12
    assert "runs" not in again.out.splitlines()[0]
    assert rows_of(folder / "kme-all.csv") == runs
