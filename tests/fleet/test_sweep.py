"""`kantor sweep`: plans, journals, tables, and workers and commands that are interrupted."""

import json
import os
import signal
import statistics
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest

from kantor_fleet.execution.experiment import Case, Outcome, run_case
from kantor_fleet.execution.pools import Pool, local
from kantor_fleet.exits import Exit
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey, SweepError, parse_seeds, plan
from kantor_fleet.sweep.run import SweepConfig, sweep
from kantor_fleet.sweep.summary import Distribution
from support.files import rows_of, wait_until
from support.limits import EVENT_LIMIT_S
from support.processes.workers import DEADLY_SEED, die_of_a_seed, fail_of_a_seed
from support.strategies import mission

if TYPE_CHECKING:
    from support.processes.command import CommandServer, Finished, Kantor

SMALL = (
    "--set", "energy.points=400", "energy.steps=400", "samples.count=200", "targets.count=50",
)  # fmt: skip
VARIED = ("--vary", "radio.range_m=50,100", "merge=ledger,min")
RUNS = 24
FULL = (*VARIED, "--seeds", "0:6", *SMALL)


def journal_lines(folder: Path) -> list[bytes]:
    """The whole lines of a journal, without its header."""
    try:
        return (folder / "runs.jsonl").read_bytes().split(b"\n")[1:-1]
    except FileNotFoundError:
        return []


# Plans


def test_a_file_of_faults_is_added_to_every_variant(tmp_path: Path) -> None:
    """It makes other runs of them."""
    storm = tmp_path / "storm.toml"
    storm.write_text("[[faults]]\nkind = 'drop'\nprobability = 0.5\n")
    calm = plan("fleet", ["planner.horizon=1,2"], "0")
    rough = plan("fleet", ["planner.horizon=1,2"], "0", (), storm)

    assert [len(variant.scenario.faults) for variant in rough.variants] == [1, 1]
    assert len({v.digest for v in (*calm.variants, *rough.variants)}) == 4


def test_a_plan_is_the_product_of_its_values_with_the_same_seeds() -> None:
    """The last key is the fastest; seeds are walked through together, so that pairs come early."""
    made = plan("fleet", ["radio.range_m=50,100", "planner.horizon=1,2"], "4,0:2")

    assert made.keys == ("radio.range_m", "planner.horizon")
    assert [variant.values for variant in made.variants] == [(50, 1), (50, 2), (100, 1), (100, 2)]
    assert made.variants[2].scenario.radio.range_m == 100.0
    assert [case.seed for _, case in made.cases()] == [4] * 4 + [0] * 4 + [1] * 4
    assert len({key for key, _ in made.cases()}) == 12


def test_values_may_have_commas_in_brackets() -> None:
    """An array is one value."""
    one, other = plan(
        "fleet", ["domain.max_m=[1800.0,1600.0],[2000.0,1700.0]"], "0"
    ).variants  # fmt: skip

    assert one.scenario.domain.max_m == (1800.0, 1600.0)
    assert other.scenario.domain.max_m == (2000.0, 1700.0)


def test_a_run_is_known_by_what_is_in_its_files_not_by_where_they_are(tmp_path: Path) -> None:
    """The same points elsewhere are the same scenario; other points in the same place are not."""

    def digest(name: str, points: str) -> str:
        path = tmp_path / name
        path.write_text(points)
        return plan("fleet", [], "0", [f"samples.file={path}"]).variants[0].digest

    here = digest("here.csv", "x,y\n1,1\n2,2\n")

    assert digest("there.csv", "x,y\n1,1\n2,2\n") == here
    assert digest("here.csv", "x,y\n1,1\n2,3\n") != here


@pytest.mark.parametrize(
    ("text", "seeds"), [("0:3", (0, 1, 2)), ("7", (7,)), ("1,4,9", (1, 4, 9)), ("5,0:2", (5, 0, 1))]
)
def test_seeds_are_parsed(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("vary", "seeds", "override", "message"),
    [
        ("radio.rang_m=3,4", "0", "", "radio.rang_m: no such key; did you mean range_m?"),
        ("radio.range_m=50,wide", "0", "", "radio.range_m=wide: "),
        ("radio.range_m=50,-1", "0", "", "radio.range_m: expected `float` >= 0.0"),
        ("radio.range_m=50,,60", "0", "", "a value is missing; write radio.range_m=value,value"),
        ("radio.range_m=", "0", "", "a value is missing"),
        ("radio.range_m", "0", "", "--vary radio.range_m: write it as key.sub=value,value"),
        ("radio.range_m=50,50.0", "0", "", "radio.range_m=50 and radio.range_m=50.0 are the same"),
        ("radio.range_m=50,60", "0", "radio.range_m=3", "--set radio.range_m=3: it is varied as well"),
        ("samples.file=nowhere.csv", "0", "", "nowhere.csv: no such file"),
        ("radio.range_m=50,60", "5:5", "", "--seeds 5:5: no seeds; the end is not one of them"),
        ("radio.range_m=50,60", "-1:5", "", "--seeds -1:5: give whole numbers from 0"),
        ("radio.range_m=50,60", "few", "", "--seeds few: write 0:50, 7, or 1,4,9"),
        ("radio.range_m=50,60", "0:3,2", "", "--seeds 0:3,2: a seed is given twice"),
        ("radio.range_m=50,60", "0:9999999999999", "", "at most 1000000 seeds"),
    ],
)  # fmt: skip
def test_a_sweep_that_cannot_be_run_is_refused_before_it_runs(
    vary: str, seeds: str, override: str, message: str
) -> None:
    """Every variant is checked first; one line names the place and the remedy."""
    with pytest.raises(SweepError) as caught:
        plan("fleet", [vary], seeds, [override] if override else [])

    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_key_that_is_varied_twice_is_refused() -> None:
    """Its values belong together."""
    with pytest.raises(SweepError, match=r"--vary radio.drop: given 2 times; put all its values"):
        plan("fleet", ["radio.drop=0.1", "radio.drop=0.2"], "0")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--vary", "radio.rang_m=1,2"), "did you mean range_m?"),
        (("--plot", "detection"), "--plot detection: no such measure; did you mean detection_rate?"),
        (("--jobs", "0"), "--jobs 0: give at least 1"),
        (("--cluster", "slurm"), "--cluster slurm: give --jobs, the number of Slurm jobs"),
    ],
)  # fmt: skip
def test_the_command_refuses_in_one_line_and_leaves_nothing(
    kantor: "Kantor", arguments: tuple[str, ...], message: str
) -> None:
    """Exit code 2, and no folder."""
    finished = kantor("sweep", "fleet", *arguments)

    assert (finished.code, finished.out) == (2, "")
    assert message in finished.err
    assert len(finished.err.splitlines()) == 1
    assert not list(kantor.folder.iterdir())


@pytest.mark.parametrize(
    ("arguments", "library", "message"),
    [
        (("--format", "parquet"), "pyarrow", "pip install 'kantor[parquet]'"),
        (("--cluster", "tcp://127.0.0.1:9"), "distributed", "pip install 'kantor[cluster]'"),
    ],
)
def test_an_option_without_its_extra_names_the_extra(
    kantor: "Kantor", arguments: tuple[str, ...], library: str, message: str
) -> None:
    """As where the extra is not installed."""
    (kantor.folder / "sitecustomize.py").write_text(
        "import importlib.util as util\nfind = util.find_spec\n"
        f"util.find_spec = lambda name, *rest: None if name == {library!r} else find(name, *rest)\n"
    )

    finished = kantor("sweep", "fleet", *arguments, PYTHONPATH=str(kantor.folder))

    assert finished.code == 2
    assert message in finished.err
    assert not (kantor.folder / "sweeps").exists()


# The journal

KEY, OUTCOME = RunKey("scenario", "code", 3, exact=False), Outcome(failed="thunder", wall_s=1.5)


def test_a_journal_keeps_runs_and_forgets_a_torn_line(tmp_path: Path) -> None:
    """What was cut off is as if it had not been written, at whatever byte."""
    path = tmp_path / "runs.jsonl"
    with RunsJournal(path) as journal:
        journal.add(KEY, OUTCOME)
    whole = path.read_bytes()

    for torn in range(1, len(whole) + 1):
        path.write_bytes(whole[:torn])
        with RunsJournal(path) as journal:
            assert journal.outcomes == ({KEY: OUTCOME} if torn == len(whole) else {})
            journal.add(KEY, OUTCOME)
        assert path.read_bytes() == whole + whole.splitlines(keepends=True)[1] * (
            torn == len(whole)
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b'{"format":1,"kantor":"0.0.9"}\n', "written by kantor 0.0.9, this is"),
        (b"my shopping list", "no journal of a sweep; give another --out"),
        (b"my shopping list\nmilk\n", "no journal of a sweep; give another --out"),
    ],
)
def test_a_file_that_is_no_journal_of_this_version_is_left_alone(
    tmp_path: Path, text: bytes, message: str
) -> None:
    """Another version's, or no journal at all."""
    path = tmp_path / "runs.jsonl"
    path.write_bytes(text)

    with pytest.raises(SweepError, match=message):
        RunsJournal(path)

    assert path.read_bytes() == text


def test_a_line_that_is_no_run_is_named(tmp_path: Path) -> None:
    """It was not torn, so it is not dropped."""
    path = tmp_path / "runs.jsonl"
    with RunsJournal(path):
        pass
    path.write_bytes(path.read_bytes() + b'{"scenario":1}\n')

    with pytest.raises(SweepError, match=r"line 2 is no run .* remove it"):
        RunsJournal(path)


def test_two_sweeps_do_not_write_into_one_journal(tmp_path: Path) -> None:
    """The second is refused."""
    with (
        RunsJournal(tmp_path / "runs.jsonl"),
        pytest.raises(SweepError, match="another sweep writes"),
    ):
        RunsJournal(tmp_path / "runs.jsonl")


# Workers


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (die_of_a_seed, "its worker died: SIGKILL"),
        (fail_of_a_seed, "its worker died: exit code 7"),
    ],
)
def test_a_case_that_kills_its_worker_fails_alone(
    work: Callable[[Case], Outcome], message: str
) -> None:
    """It has a second try; the others have their outcomes, each once."""
    cases = [Case(mission(), seed) for seed in range(8)]
    with closing(local(cases, 2, work)) as pool:
        done = [one for one in pool if one is not None]

    failed = {case.seed: outcome.failed for case, outcome in done if outcome.failed}
    assert failed == {DEADLY_SEED: message}
    assert sorted(case.seed for case, _ in done) == list(range(8))
    assert done[-1][0].seed == DEADLY_SEED


def test_a_pool_that_is_closed_leaves_no_worker() -> None:
    """At once, with cases under way."""
    cases = [Case(mission(), seed) for seed in range(100)]
    pool = local(cases, 2)
    first = next(one for one in pool if one is not None)
    worker = int(first[1].worker.rpartition(":")[2])
    assert psutil.pid_exists(worker)

    pool.close()

    assert not psutil.pid_exists(worker)


def test_whatever_a_run_raises_is_its_outcome(tmp_path: Path) -> None:
    """One line, without a traceback."""
    path = tmp_path / "empty.csv"
    path.write_text("x,y\n")

    outcome = run_case(Case(mission(f"samples.file={path}"), 0))

    assert outcome.result is None
    assert outcome.failed == f"samples.file: {path}: no points in it; give at least one"


# Numbers


def test_a_distribution_is_exact_and_the_same_every_time() -> None:
    """Median and quartiles as `statistics` has them; the interval holds the median of its source."""
    draws = np.random.default_rng(1).normal(50.0, 5.0, (200, 25))
    distributions = [Distribution.of(row) for row in draws]
    first, median, third = statistics.quantiles(draws[0].tolist(), n=4, method="inclusive")

    assert distributions[0][:4] == pytest.approx((25, median, first, third))
    assert Distribution.of(draws[0]) == distributions[0]
    covered = sum(one.low <= 50.0 <= one.high for one in distributions) / len(distributions)
    assert 0.90 <= covered <= 0.99
    assert Distribution.of(np.array([4.0])) == (1, 4.0, 4.0, 4.0, None, None)
    assert Distribution.of(np.array([])) == (0, None, None, None, None, None)
    assert Distribution.of(np.array([2.0, 2.0])) == (2, 2.0, 2.0, 2.0, 2.0, 2.0)


# The command

group = pytest.mark.xdist_group("sweep")  # they share a fixture that is dear


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory, command_server: "CommandServer") -> Path:
    """The folder of a whole sweep that one worker ran."""
    from support.processes.command import Kantor

    kantor = Kantor(tmp_path_factory.mktemp("reference"), command_server)
    finished = kantor("sweep", "fleet", *FULL, "--jobs", 1)
    assert finished.code == 0, finished.err
    assert "detection_rate" in finished.out
    return kantor.folder / "sweeps" / "fleet"


def same(one: Path, other: Path) -> bool:
    """Whether two sweeps left the same numbers, byte for byte."""
    return all(
        (one / name).read_bytes() == (other / name).read_bytes()
        for name in ("table.csv", "summary.csv")
    )


def test_a_sweep_of_maps_has_their_columns(kantor: "Kantor") -> None:
    """What is measured on maps stands in the tables of missions on maps, and in no other."""
    small = ("--set", "map.size_m=[16, 16]", "starts.spots=0")
    finished = kantor(
        "sweep", "blank", *small, "--vary", "robots.count=1,2", "--seeds", "0:2", "--jobs", 1
    )
    table = rows_of(kantor.folder / "sweeps" / "blank" / "table.csv")
    summary = rows_of(kantor.folder / "sweeps" / "blank" / "summary.csv")

    assert finished.code == 0, finished.err
    assert [float(row["map_explored"]) for row in table] == [1.0] * 4
    assert all(float(row["map_wtv_final_r8"]) > 0.0 for row in table)
    assert "map_epv_mean_r64" in {row["measure"] for row in summary}
    assert "map_distance_m" in finished.out


@group
def test_a_sweep_leaves_its_folder(reference: Path) -> None:
    """A row for each run in the order of the plan; a result's fields; the times apart."""
    table, summary = rows_of(reference / "table.csv"), rows_of(reference / "summary.csv")

    assert {path.name for path in reference.iterdir()} == {
        "plot.png", "runs.jsonl", "summary.csv", "sweep.json", "table.csv", "timings.csv",
    }  # fmt: skip
    assert [(row["radio.range_m"], row["merge"], row["seed"]) for row in table] == [
        (range_m, merge, str(seed))
        for range_m in ("50", "100")
        for merge in ("ledger", "min")
        for seed in range(6)
    ]
    assert {"w_ub_paper", "bytes_per_robot_tick_total", "digest", "failed"} <= set(table[0])
    assert "wall_s" not in table[0]
    assert not any(name.startswith("map_") for name in table[0])
    assert not any(row["measure"].startswith("map_") for row in summary)
    assert len(rows_of(reference / "timings.csv")) == RUNS
    assert (reference / "plot.png").read_bytes().startswith(b"\x89PNG")

    ticks = [
        [int(row["finished_tick"]) for row in table[first : first + 6]] for first in (0, 6)
    ]  # fmt: skip
    line = next(
        row for row in summary
        if (row["radio.range_m"], row["merge"], row["measure"]) == ("50", "min", "finished_tick")
    )  # fmt: skip
    assert float(line["median"]) == statistics.median(ticks[1])
    assert float(line["difference_median"]) == statistics.median(
        mine - first for first, mine in zip(*ticks, strict=True)
    )


@group
def test_interrupted_and_resumed_it_leaves_the_same_table(
    kantor: "Kantor", reference: Path
) -> None:
    """Ctrl-C after a third: workers gone, runs kept, none repeated, whatever the number of jobs."""
    folder = kantor.folder / "sweeps" / "fleet"
    process = kantor.start("sweep", "fleet", *FULL, "--jobs", 2)
    wait_until(lambda: len(journal_lines(folder)) >= RUNS // 3)
    started = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    kept = journal_lines(folder)
    assert process.returncode == 130
    assert f"{len(kept)} of {RUNS} runs are done; the same command goes on from there" in out
    assert err == ""
    assert RUNS // 3 <= len(kept) < RUNS
    assert len(rows_of(folder / "table.csv")) == len(kept)
    assert psutil.wait_procs(started, timeout=EVENT_LIMIT_S)[1] == []

    finished = kantor("sweep", "fleet", *FULL, "--jobs", 2)

    assert finished.code == 0, finished.err
    assert journal_lines(folder)[: len(kept)] == kept
    assert len(journal_lines(folder)) == RUNS
    assert same(folder, reference)


def test_sigterm_ends_it_with_143(kantor: "Kantor") -> None:
    """As a batch system does."""
    process = kantor.start("sweep", "fleet", *FULL)
    wait_until(lambda: bool(journal_lines(kantor.folder / "sweeps" / "fleet")))
    process.terminate()

    process.communicate(timeout=EVENT_LIMIT_S)
    assert process.returncode == 143


@group
def test_a_worker_that_is_killed_costs_nothing(kantor: "Kantor", reference: Path) -> None:
    """Its case is run again; the table is the same."""
    folder = kantor.folder / "sweeps" / "fleet"
    process = kantor.start("sweep", "fleet", *FULL, "--jobs", 2)
    wait_until(lambda: bool(journal_lines(folder)))
    worker = json.loads(journal_lines(folder)[0])["outcome"]["worker"]
    os.kill(int(worker.rpartition(":")[2]), signal.SIGKILL)
    _, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert (process.returncode, err) == (0, "")
    assert same(folder, reference)


def test_a_wider_sweep_runs_only_what_is_new(kantor: "Kantor") -> None:
    """And a narrower one nothing; the table is always of the last plan."""
    folder = kantor.folder / "sweeps" / "fleet"

    def swept(vary: str, seeds: str) -> "Finished":
        return kantor("sweep", "fleet", "--vary", vary, "--seeds", seeds, *SMALL)

    swept("radio.range_m=50", "0:2")
    assert len(journal_lines(folder)) == 2
    swept("radio.range_m=100,50", "0:3")
    assert len(journal_lines(folder)) == 6
    swept("radio.range_m=50", "1")
    assert len(journal_lines(folder)) == 6
    assert [row["seed"] for row in rows_of(folder / "table.csv")] == ["1"]


def test_a_run_that_fails_is_kept_with_its_reason(kantor: "Kantor") -> None:
    """It does not stop the others, is run again only on request, and shows in the exit code."""
    (kantor.folder / "good.csv").write_text("x,y\n" + "800,700\n810,720\n" * 40)
    (kantor.folder / "bad.csv").write_text("x,y\n800,nan\n")
    arguments = (
        "sweep", "fleet", "--vary", "samples.file=good.csv,bad.csv", "--seeds", "0:2", "--set",
        "energy.points=100", "energy.steps=100", "targets.count=5", "--format", "parquet",
    )  # fmt: skip
    folder = kantor.folder / "sweeps" / "fleet"

    first = kantor(*arguments)
    again = kantor(*arguments)

    assert (first.code, again.code) == (1, 1)
    assert first.out.count("a run failed: ") == 1, "one reason, printed once"
    assert "2 failed: " in again.out
    assert "row 1 is not finite" in again.out
    assert len(journal_lines(folder)) == 4
    from pyarrow import parquet

    table = parquet.read_table(folder / "table.parquet").to_pylist()
    assert [row["failed"] is None for row in table] == [True, True, False, False]
    assert [row["energy_total"] for row in table] == [500, 500, None, None]
    assert (folder / "plot.png").exists(), "boxes, for words on x"

    assert kantor(*arguments, "--retry-failed").code == 1
    assert len(journal_lines(folder)) == 6


def thunder(cases: Iterable[Case]) -> Pool:
    """A pool in which every run fails."""
    for case in cases:
        yield case, Outcome(failed="thunder")


def test_failed_runs_show_in_the_exit_code(tmp_path: Path) -> None:
    """Whatever the pool."""
    config = SweepConfig(plan("fleet", [], "0:2"), tmp_path)

    assert sweep(config, thunder) is Exit.NOT_MET
    assert [row["failed"] for row in rows_of(tmp_path / "table.csv")] == ["thunder", "thunder"]


def test_changed_sources_and_exact_distances_are_other_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results of an edited planner are not those of the old one."""
    plans = plan("fleet", [], "0:2"), plan("fleet", [], "0:2", exact=True)
    for made in plans:
        sweep(SweepConfig(made, tmp_path), thunder)
        sweep(SweepConfig(made, tmp_path), thunder)
    assert len(journal_lines(tmp_path)) == 4

    monkeypatch.setattr("kantor_fleet.sweep.plan.code", lambda: "edited")
    sweep(SweepConfig(plans[0], tmp_path), thunder)
    assert len(journal_lines(tmp_path)) == 6
