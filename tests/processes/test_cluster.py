"""Sweeps beyond one machine: real Dask schedulers and workers, and Slurm commands that are played."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest

from kantor_fleet.execution import pools
from kantor_fleet.execution.experiment import Case
from kantor_fleet.exits import Exit
from kantor_fleet.sweep.plan import SweepPlan, plan
from kantor_fleet.sweep.run import SweepConfig, sweep
from support.limits import EVENT_LIMIT_S
from support.processes import workers
from support.strategies import mission

if TYPE_CHECKING:
    from support.processes.command import Kantor, Process

SMALL = ("energy.points=400", "energy.steps=400", "samples.count=200", "targets.count=50")
VARY, SEEDS = "radio.range_m=50,100", "0:10"
RUNS = 20
ENVIRONMENT = {"PYTHONPATH": str(Path(workers.__file__).parents[2])}
"""Of a cluster: its workers find the tests' work."""


pytestmark = pytest.mark.xdist_group("cluster")


class Cluster:
    """A Dask scheduler and two workers, a process each, without nannies that start them again."""

    def __init__(self, folder: Path, processes: ExitStack) -> None:
        self._folder, self._processes = folder, processes
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        self.address = _line(self.scheduler, "Scheduler at:").split()[-1]
        self.workers = [
            self._start("worker", self.address, "--no-nanny", "--nthreads", "1") for _ in range(2)
        ]
        for worker in self.workers:
            _line(worker, "Starting established connection to")

    def _start(self, role: str, *arguments: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{role}", *arguments, "--no-dashboard"],
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | ENVIRONMENT,
        )
        self._processes.callback(process.communicate)
        self._processes.callback(process.kill)
        return process


def _line(process: "subprocess.Popen[str]", part: str) -> str:
    """The first line of a log that has a part."""
    assert process.stderr is not None
    return next(line for line in process.stderr if part in line)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A cluster of this machine."""
    with ExitStack() as processes:
        yield Cluster(tmp_path, processes)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep that processes of this machine ran."""
    folder = tmp_path_factory.mktemp("reference")
    assert sweep(SweepConfig(small_plan(), folder), partial(pools.local, jobs=2)) is Exit.DONE
    return folder


def small_plan() -> SweepPlan:
    return plan("fleet", [VARY], SEEDS, SMALL)


def sweep_command(folder: Path, *arguments: object) -> tuple[object, ...]:
    return ("sweep", "fleet", "--vary", VARY, "--seeds", SEEDS, "--set", *SMALL, "--out", folder,
            *arguments)  # fmt: skip


def same(one: Path, other: Path) -> bool:
    """Whether two sweeps left the same table, byte for byte."""
    return (one / "table.csv").read_bytes() == (other / "table.csv").read_bytes()


def await_run(process: "Process") -> None:
    """Until the first run is done."""
    assert process.stdout is not None
    assert any(line.startswith("1/") for line in process.stdout)


def test_a_worker_dies_and_the_table_is_that_of_one_machine(
    kantor: "Kantor", cluster: Cluster, reference: Path
) -> None:
    """Dask runs elsewhere what it had; both workers had runs."""
    folder = kantor.folder / "out"
    process = kantor.start(*sweep_command(folder, "--cluster", cluster.address))
    await_run(process)
    cluster.workers[0].send_signal(signal.SIGKILL)
    _, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert (process.returncode, err) == (0, "")
    assert same(folder, reference)
    assert str(cluster.workers[1].pid) in (folder / "timings.csv").read_text()


def tables_of(out: str) -> list[str]:
    """What a campaign tells in the end, but for times and where it ran."""
    lines = out[out.index(" missions, ") :].splitlines()[1:]
    return [line for line in lines if not line.startswith("  speed")]


def test_a_campaign_on_a_cluster_that_loses_a_worker_tells_what_one_process_tells(
    kantor: "Kantor", cluster: Cluster
) -> None:
    """The same missions, totals and tables, whatever the order in which missions end."""
    seeds = ("campaign", "--seeds", 10)
    alone = kantor(*seeds, "--jobs", 1, "--out", "alone")
    process = kantor.start(*seeds, "--cluster", cluster.address, "--out", "cluster")
    await_run(process)
    cluster.workers[0].send_signal(signal.SIGKILL)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert (alone.code, process.returncode, err) == (0, 0, "")
    assert tables_of(out) == tables_of(alone.out)
    assert len(tables_of(out)) > 20


def test_a_figure_on_a_cluster_is_that_of_one_process(kantor: "Kantor", cluster: Cluster) -> None:
    """The same numbers and verdicts to the byte."""
    command = ("reproduce", "fig8", "--runs", 2)
    alone = kantor(*command, "--jobs", 1, "--out", "alone")
    shared = kantor(*command, "--cluster", cluster.address, "--out", "cluster")

    assert alone.code == shared.code
    for name in ("fig8.csv", "verdicts.csv"):
        one, other = (kantor.folder / place / name for place in ("alone", "cluster"))
        assert one.read_bytes() == other.read_bytes()


def test_campaigns_and_figures_without_a_cluster_end_with_exit_code_4(kantor: "Kantor") -> None:
    """One line, and what is done is kept."""
    nowhere = ("--cluster", "127.0.0.1:9")
    for command in (("campaign", "--seeds", 2), ("reproduce", "fig4", "--runs", 2)):
        finished = kantor(*command, *nowhere)

        assert finished.code == 4
        assert "127.0.0.1:9: no Dask scheduler there (" in finished.err
        assert finished.err.count("\n") == 1


def test_a_case_that_kills_workers_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask gives it up; the pool goes on with the workers that are left."""
    monkeypatch.setitem(ENVIRONMENT, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    cases = [Case(mission(), seed) for seed in (workers.DEADLY_SEED, 4, 5)]
    with ExitStack() as processes:
        address = Cluster(tmp_path, processes).address
        pool = pools.cluster(cases, address, work=workers.die_of_a_seed)
        done = {case.seed: outcome for case, outcome in filter(None, pool)}

    assert done.keys() == {case.seed for case in cases}
    assert done[workers.DEADLY_SEED].failed == "its worker died, and so did the others that tried"


def test_the_scheduler_goes_and_the_sweep_goes_on_elsewhere(
    kantor: "Kantor", cluster: Cluster, reference: Path
) -> None:
    """Exit code 4 with one line; what is done is kept, and this machine does the rest."""
    folder = kantor.folder / "out"
    process = kantor.start(*sweep_command(folder, "--cluster", cluster.address))
    await_run(process)
    cluster.scheduler.kill()
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert process.returncode == 4
    assert err == f"kantor: {cluster.address}: the scheduler is gone\n"
    assert f"of {RUNS} runs are done; the same command goes on from there" in out

    kept = (folder / "runs.jsonl").read_bytes()
    assert kantor(*sweep_command(folder)).code == 0
    assert (folder / "runs.jsonl").read_bytes().startswith(kept)
    assert same(folder, reference)


def test_ctrl_c_gives_up_what_a_cluster_is_running(kantor: "Kantor", cluster: Cluster) -> None:
    """The workers are not ours to end, and stay."""
    folder = kantor.folder / "out"
    process = kantor.start(*sweep_command(folder, "--cluster", cluster.address))
    await_run(process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert (process.returncode, err) == (130, "")
    assert [worker.poll() for worker in cluster.workers] == [None, None]


def test_an_unreachable_cluster_ends_with_exit_code_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 4 after a bounded time, in one line."""
    monkeypatch.setattr(pools, "_CONNECT_S", 0.3)
    address = "tcp://127.0.0.1:9"

    code = sweep(SweepConfig(small_plan(), tmp_path), partial(pools.cluster, address=address))

    assert code is Exit.UNREACHABLE
    err = capsys.readouterr().err
    assert err.startswith(f"kantor: {address}: no Dask scheduler there (")
    assert err.count("\n") == 1


def test_a_server_that_is_no_scheduler_ends_with_exit_code_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether it answers nothing or something else: one line after a bounded time, and no client is left."""
    monkeypatch.setattr(pools, "_CONNECT_S", 0.5)
    for answer in (b"", b"HTTP/1.0 400 Bad Request\r\n\r\n" + b"x" * 4000):
        with socket.create_server(("127.0.0.1", 0)) as server:
            address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
            answering = threading.Thread(target=_answer, args=(server, answer), daemon=True)
            answering.start()
            start = partial(pools.cluster, address=address)
            code = sweep(SweepConfig(small_plan(), tmp_path), start)
            server.shutdown(socket.SHUT_RDWR)
            answering.join()

        assert code is Exit.UNREACHABLE
        err = capsys.readouterr().err
        assert err.startswith(f"kantor: {address}: no Dask scheduler there (")
        assert err.count("\n") == 1


def _answer(server: socket.socket, answer: bytes) -> None:
    """Answer every connection and keep it open until the server is shut down."""
    kept = []
    with suppress(OSError):
        while True:
            connection, _ = server.accept()
            kept.append(connection)
            connection.sendall(answer)
    for connection in kept:
        connection.close()


def test_slurm_jobs_are_requested_and_cancelled(kantor: "Kantor", reference: Path) -> None:
    """With the user's settings of dask-jobqueue; here sbatch starts the job on the spot."""
    commands = kantor.folder / "bin"
    commands.mkdir()
    played = {
        "sbatch": 'cp "$1" job.sh; setsid sh job.sh >job.log 2>&1 & '
        'echo $! >>jobs; echo "Submitted batch job $!"',
        "scancel": 'for job in "$@"; do kill -- "-$job"; done; echo "$@" >>cancelled',
    }
    for name, script in played.items():
        (commands / name).write_text(f"#!/bin/sh\n{script}\n")
        (commands / name).chmod(0o755)

    folder = kantor.folder / "out"
    finished = kantor(
        *sweep_command(folder, "--cluster", "slurm", "--jobs", 1),
        PATH=f"{commands}{os.pathsep}{os.environ['PATH']}",
        DASK_JOBQUEUE__SLURM__CORES="1",
        DASK_JOBQUEUE__SLURM__MEMORY="1GB",
    )

    assert (finished.code, finished.err) == (0, "")
    assert same(folder, reference)
    jobs = (kantor.folder / "jobs").read_text().split()
    assert (kantor.folder / "cancelled").read_text().split() == jobs
    gone = [psutil.Process(int(job)) for job in jobs if psutil.pid_exists(int(job))]
    assert psutil.wait_procs(gone, timeout=EVENT_LIMIT_S)[1] == []


def test_slurm_that_accepts_no_jobs_ends_with_exit_code_4(kantor: "Kantor") -> None:
    """One line tells what is missing."""
    arguments = sweep_command(kantor.folder / "out", "--cluster", "slurm", "--jobs", 1)

    finished = kantor(*arguments)
    assert finished.code == 4
    assert "slurm: no sbatch here; run this on a machine that submits jobs" in finished.err

    (kantor.folder / "sbatch").write_text("#!/bin/sh\necho no such partition >&2; exit 1\n")
    (kantor.folder / "sbatch").chmod(0o755)
    path = f"{kantor.folder}{os.pathsep}{os.environ['PATH']}"
    finished = kantor(*arguments, PATH=path)
    assert finished.code == 4
    assert "jobqueue.yaml" in finished.err
    assert len(finished.err.splitlines()) == 1

    settings = {"DASK_JOBQUEUE__SLURM__CORES": "1", "DASK_JOBQUEUE__SLURM__MEMORY": "1GB"}
    finished = kantor(*arguments, PATH=path, **settings)
    assert finished.code == 4
    assert finished.err.startswith("kantor: slurm: no such partition; see ")
    assert len(finished.err.splitlines()) == 1


def test_the_plan_is_left_as_json(reference: Path) -> None:
    """Every scenario resolved, beside the runs."""
    told = json.loads((reference / "sweep.json").read_text())

    assert told["seeds"] == list(range(10))
    assert [variant["varied"] for variant in told["variants"]] == [
        {"radio.range_m": 50},
        {"radio.range_m": 100},
    ]
    assert told["variants"][0]["scenario"]["samples"]["count"] == 200
