"""Pools that run cases: in processes of this machine, or on a Dask cluster.

A pool is a generator. It yields every case with its outcome as it completes, in any order, and None
when nothing has completed for a moment, so that its caller can look for signals. Closing it ends the
cases that are running.
"""

import asyncio
import importlib.util
import logging
import os
import shutil
import signal
import socket
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.util import get_temp_dir
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from kantor_fleet.execution.experiment import Case, Outcome, code, reason, run_case
from kantor_fleet.execution.fork_server import await_fork_server, pipe, start_process
from kantor_fleet.execution.leftovers import Leftovers
from kantor_fleet.exits import Exit, fail

if TYPE_CHECKING:
    from dask_jobqueue import SLURMCluster
    from distributed import Client, Future

Work = Callable[[Case], Outcome]
Pool = Generator[tuple[Case, Outcome] | None]

SLURM = "slurm"
"""The address of a Dask cluster of Slurm jobs that is started for this command."""
_POLL_S = 0.1
_CONNECT_S = 10.0
_AHEAD_MIN = 8
"""Workers may yet come."""


class ClusterError(Exception):
    """A cluster that cannot be used; the message is one line with the place and the remedy."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def pool(
    jobs: int | None = None, address: str | None = None, work: Work = run_case
) -> Callable[[Iterable[Case]], Pool]:
    """The pool that a user asks for, as a function of cases; ends the command if there is none."""
    if jobs is not None and jobs < 1:
        fail(Exit.USAGE, f"--jobs {jobs}: give at least 1")
    if address is None:
        return partial(local, jobs=jobs or cores(), work=work)
    if importlib.util.find_spec("distributed") is None:
        fail(Exit.USAGE, "--cluster: needs Dask; pip install 'kantor[cluster]'")
    if address == SLURM and jobs is None:
        fail(Exit.USAGE, "--cluster slurm: give --jobs, the number of Slurm jobs")
    if address != SLURM and jobs is not None:
        fail(
            Exit.USAGE,
            f"--jobs {jobs}: the cluster at {address} has its own workers; drop one of the two",
        )
    if address != SLURM and (problem := _problem_of(address)):
        fail(
            Exit.USAGE,
            f"--cluster {address}: {problem}; write HOST:PORT, such as localhost:8786, or slurm",
        )
    return partial(cluster, address=address, jobs=jobs, work=work)


def _problem_of(address: str) -> str | None:
    """Why nothing can be reached at an address of a scheduler, whatever runs there."""
    try:
        parts = urlsplit(_with_scheme(address))
        if parts.scheme not in _SCHEMES:
            return f"unknown protocol {parts.scheme}; known: {', '.join(_SCHEMES)}"
        if not parts.hostname:
            return "no host in it"
        if not parts.port:
            return "no port in it"
    except ValueError as error:
        return str(error).lower()
    return "more than a host and a port in it" if parts.path.strip("/") or parts.query else None


def _with_scheme(address: str) -> str:
    return address if "://" in address else f"tcp://{address}"


_SCHEMES = ("tcp", "tls", "ucx", "ws", "wss")
"""Protocols of Dask by which a scheduler is reached."""


def local(cases: Iterable[Case], jobs: int, work: Work = run_case) -> Pool:
    """Run cases in `jobs` processes of this machine.

    A worker that dies, such as one killed for its use of memory, affects only its own case. That case is tried
    once more at the end, with no other beside it; if that worker dies too, the case has failed.
    """
    with Leftovers(Path(get_temp_dir())):
        await_fork_server()
        yield None  # a caller that was interrupted meanwhile leaves here
        suspects: list[Case] = []
        with closing(_in_processes(cases, jobs, work)) as running:
            for done in running:
                if done is not None and done.died:
                    suspects.append(done.case)
                else:
                    yield done and (done.case, done.outcome)
        with closing(_in_processes(suspects, 1, work)) as running:
            for done in running:
                yield done and (done.case, done.outcome)


def cluster(
    cases: Iterable[Case], address: str, jobs: int | None = None, work: Work = run_case
) -> Pool:
    """Run cases on the Dask cluster whose scheduler has this address, or in `jobs` Slurm jobs.

    When a worker dies Dask runs its cases elsewhere; a case that kills several has failed. Cases are asked for as
    workers need them. Raises ClusterError if there is no cluster, or no longer.
    """
    with _client(address, jobs) as client:
        arrived: SimpleQueue[Future] = SimpleQueue()
        pending: dict[Future, Case] = {}
        waiting, here = iter(cases), code()
        ahead = _ahead(client, address)
        try:
            while True:
                for case in islice(waiting, max(0, ahead - len(pending))):
                    future = client.submit(_run_remotely, work, case, here, pure=False)
                    pending[future] = case
                    future.add_done_callback(arrived.put)
                if not pending:
                    return
                try:
                    future = arrived.get(timeout=_POLL_S)
                except Empty:
                    ahead = _ahead(client, address)
                    yield None
                else:
                    yield pending.pop(future), _collected(future, address)
        finally:
            client.cancel(list(pending))


def _ahead(client: "Client", address: str) -> int:
    """Cases that are submitted at a time: none of the workers waits, and few are left when the time is up.

    Raises ClusterError.
    """
    try:
        threads: dict[str, int] = client.nthreads()
    except OSError:
        raise ClusterError(f"{address}: the scheduler is gone") from None
    return max(_AHEAD_MIN, 2 * sum(threads.values()))


class _Completed(NamedTuple):
    case: Case
    outcome: Outcome
    died: bool = False
    """The worker died before it had an outcome."""


class _WorkerProcess:
    """A process that runs one case after another."""

    def __init__(self, work: Work) -> None:
        self.pipe, theirs = pipe("worker")
        with theirs:  # so that the pipe ends when the process does
            self._process = start_process("worker", _serve, theirs, work)

    def finish(self, case: Case) -> _Completed:
        """The outcome of the case that it was given; call it when the pipe is ready."""
        try:
            return _Completed(case, self.pipe.recv())
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return _Completed(case, Outcome(failed=f"its worker died: {how}"), died=True)

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _in_processes(cases: Iterable[Case], jobs: int, work: Work) -> Generator[_Completed | None]:
    waiting = iter(cases)
    idle: list[_WorkerProcess] = []
    busy: dict[object, tuple[_WorkerProcess, Case]] = {}  # by the worker's pipe
    try:
        while True:
            for case in islice(waiting, jobs - len(busy)):
                worker = idle.pop() if idle else _WorkerProcess(work)
                busy[worker.pipe] = worker, case
                worker.pipe.send(case)
            if not busy:
                return
            ready = wait([worker.pipe for worker, _ in busy.values()], _POLL_S)
            for its_pipe in ready:
                worker, case = busy.pop(its_pipe)
                done = worker.finish(case)
                if done.died:
                    worker.kill()
                else:
                    idle.append(worker)
                yield done
            if not ready:
                yield None
    finally:
        for worker in (*idle, *(worker for worker, _ in busy.values())):
            worker.kill()


def _serve(pipe: Connection, work: Work) -> None:
    """Run cases until the other end of the pipe is closed."""
    while True:
        try:
            pipe.send(work(pipe.recv()))
        except (EOFError, OSError):
            return


@contextmanager
def _client(address: str, jobs: int | None) -> Iterator["Client"]:
    """A connection to a cluster. Raises ClusterError."""
    from distributed import Client  # noqa: PLC0415  an extra

    for name in ("distributed", "distributed.client"):  # errors that matter are raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        scheduler = stack.enter_context(_slurm(jobs)) if address == SLURM else address
        try:
            if address != SLURM:
                asyncio.run(_greet(address))
            client = stack.enter_context(
                Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
            )
        except Exception as error:  # noqa: BLE001  Dask decodes whatever another server answers
            problem = str(error) or f"no answer within {_CONNECT_S:g} s"
            raise ClusterError(
                f"{address}: no Dask scheduler there ({problem}); start `dask scheduler`"
            ) from None
        yield client


async def _greet(address: str) -> None:
    """Ask a scheduler who it is: a Client waits for an answer without end, and cannot be closed without one.

    Raises OSError, TimeoutError, or whatever Dask makes of the answer of another server.
    """
    from distributed import Security  # noqa: PLC0415  an extra
    from distributed.comm import connect  # noqa: PLC0415

    parts = urlsplit(_with_scheme(address))
    async with asyncio.timeout(_CONNECT_S):
        _, writer = await asyncio.open_connection(parts.hostname, parts.port)  # refused at once
        writer.close()
        options = Security().get_connection_args("client")
        scheduler = await connect(_with_scheme(address), timeout=_CONNECT_S, **options)
        try:
            await scheduler.write({"op": "identity", "reply": True})
            answer = await scheduler.read()
        finally:
            scheduler.abort()
    if not isinstance(answer, dict) or answer.get("type") != "Scheduler":
        raise OSError("something else answers")


@contextmanager
def _slurm(jobs: int | None) -> Iterator["SLURMCluster"]:
    """A cluster of so many Slurm jobs, set up by the user's jobqueue.yaml. Raises ClusterError."""
    from dask_jobqueue import SLURMCluster  # noqa: PLC0415  an extra

    if shutil.which("sbatch") is None:
        raise ClusterError("slurm: no sbatch here; run this on a machine that submits jobs")
    warnings.filterwarnings(
        "ignore", "Port .* is already in use"
    )  # the port of the dashboard, which is not used
    try:
        slurm = SLURMCluster()
    except (ValueError, TypeError) as error:
        raise ClusterError(f"slurm: {error}; set it in ~/.config/dask/jobqueue.yaml") from None
    with slurm:
        if refusal := slurm.sync(_submit, slurm, jobs or 1):
            raise ClusterError(f"slurm: {refusal}; see ~/.config/dask/jobqueue.yaml")
        yield slurm


async def _submit(slurm: "SLURMCluster", jobs: int) -> str | None:
    """Submit jobs; why Slurm refused them, which `scale` does not report."""
    from distributed import Status  # noqa: PLC0415  an extra

    for _ in range(jobs):
        slurm.worker_spec.update(slurm.new_worker_spec())
    try:
        await slurm
    except (RuntimeError, ValueError) as error:
        for job in slurm.workers.values():
            job.status = Status.failed  # Dask cannot close a job that it believes is starting
        return str(error).rpartition("stderr:")[2].strip()
    return None


def _run_remotely(work: Work, case: Case, here: str) -> Outcome:
    """Run a case on a worker of a cluster, if it has the same sources. Raises ClusterError."""
    if code() != here:
        raise ClusterError(f"{socket.gethostname()}: another kantor; install the same everywhere")
    return work(case)


def _collected(future: "Future", address: str) -> Outcome:
    """The outcome of a case on a cluster. Raises ClusterError."""
    from distributed import KilledWorker  # noqa: PLC0415  an extra

    outcome: Outcome
    try:
        outcome = future.result()
    except ClusterError:
        raise
    except KilledWorker:
        outcome = Outcome(failed="its worker died, and so did the others that tried")
    except ImportError as error:
        raise ClusterError(
            f"{address}: no kantor on a worker ({error}); install it there"
        ) from None
    except Exception as error:  # noqa: BLE001  Dask has many for a run that fails
        if future.status != "error":  # the run itself did not fail; its outcome is lost
            raise ClusterError(f"{address}: the scheduler is gone") from None
        outcome = Outcome(failed=reason(error))
    return outcome
