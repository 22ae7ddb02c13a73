"""Where cases run: in processes of this machine, or on a Dask cluster.

A pool is a generator. It yields every case with its outcome as it completes, in any order, and None
when nothing has completed for a moment, so that whoever asks stays in charge. Closing it gives up
what is running.
"""

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
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, NamedTuple

from kantor_fleet.execution.experiment import Case, Outcome, code, reason, run_case
from kantor_fleet.execution.fork_server import await_fork_server, fork_server
from kantor_fleet.exits import Exit, fail

if TYPE_CHECKING:
    from dask_jobqueue import SLURMCluster
    from distributed import Client, Future

Work = Callable[[Case], Outcome]
Pool = Generator[tuple[Case, Outcome] | None]

SLURM = "slurm"
"""As an address: a Dask cluster of Slurm jobs that is made for the occasion."""
_GLANCE_S = 0.1
_CONNECT_S = 10.0


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
    """What takes cases, as a user asks for it; ends the command if that cannot be."""
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
    return partial(cluster, address=address, jobs=jobs, work=work)


def local(cases: Iterable[Case], jobs: int, work: Work = run_case) -> Pool:
    """Run cases in `jobs` processes of this machine.

    A worker that dies, killed for the memory it took, say, costs nobody but its own case a thing. That
    case is tried once more at the end, with nothing beside it; if it kills that worker too it has failed.
    """
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

    When a worker dies Dask runs its cases elsewhere; a case that kills several has failed. Raises
    ClusterError if there is no cluster, or no longer.
    """
    with _client(address, jobs) as client:
        arrived: SimpleQueue[Future] = SimpleQueue()
        here = code()
        pending = {client.submit(_run_there, work, case, here, pure=False): case for case in cases}
        for future in pending:
            future.add_done_callback(arrived.put)
        try:
            while pending:
                try:
                    future = arrived.get(timeout=_GLANCE_S)
                except Empty:
                    yield None
                else:
                    yield pending.pop(future), _collected(future, address)
        finally:
            client.cancel(list(pending))


class _Done(NamedTuple):
    case: Case
    outcome: Outcome
    died: bool = False
    """Its worker did, before it could tell."""


class _Worker:
    """A process that runs one case after another."""

    def __init__(self, work: Work) -> None:
        context = fork_server()
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        self._process.start()
        theirs.close()  # so that the pipe ends when the process does

    def finish(self, case: Case) -> _Done:
        """What came of the case that it was given; call it when the pipe has something."""
        try:
            return _Done(case, self.pipe.recv())
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return _Done(case, Outcome(failed=f"its worker died: {how}"), died=True)

    def kill(self) -> None:
        """End it, whatever it does."""
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _in_processes(cases: Iterable[Case], jobs: int, work: Work) -> Generator[_Done | None]:
    waiting = iter(cases)
    idle: list[_Worker] = []
    busy: dict[object, tuple[_Worker, Case]] = {}  # by the worker's pipe
    try:
        while True:
            for case in islice(waiting, jobs - len(busy)):
                worker = idle.pop() if idle else _Worker(work)
                busy[worker.pipe] = worker, case
                worker.pipe.send(case)
            if not busy:
                return
            ready = wait([worker.pipe for worker, _ in busy.values()], _GLANCE_S)
            for pipe in ready:
                worker, case = busy.pop(pipe)
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
    """Run cases until the other end is gone."""
    # The terminal's Ctrl-C reaches everybody; whoever started this process sees to its end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            pipe.send(work(pipe.recv()))
        except (EOFError, OSError):
            return


@contextmanager
def _client(address: str, jobs: int | None) -> Iterator["Client"]:
    """A connection to a cluster. Raises ClusterError."""
    from distributed import Client  # noqa: PLC0415  an extra

    for name in ("distributed", "distributed.client"):  # what matters is raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        scheduler = stack.enter_context(_slurm(jobs)) if address == SLURM else address
        try:
            client = stack.enter_context(
                Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
            )
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"{address}: no Dask scheduler there ({error}); start `dask scheduler`"
            ) from None
        yield client


@contextmanager
def _slurm(jobs: int | None) -> Iterator["SLURMCluster"]:
    """So many Slurm jobs as a cluster, as the user's jobqueue.yaml has them. Raises ClusterError."""
    from dask_jobqueue import SLURMCluster  # noqa: PLC0415  an extra

    if shutil.which("sbatch") is None:
        raise ClusterError("slurm: no sbatch here; run this on a machine that submits jobs")
    warnings.filterwarnings("ignore", "Port .* is already in use")  # of a page nobody looks at
    try:
        slurm = SLURMCluster()
    except (ValueError, TypeError) as error:
        raise ClusterError(f"slurm: {error}; set it in ~/.config/dask/jobqueue.yaml") from None
    with slurm:
        if refusal := slurm.sync(_submit, slurm, jobs or 1):
            raise ClusterError(f"slurm: {refusal}; see ~/.config/dask/jobqueue.yaml")
        yield slurm


async def _submit(slurm: "SLURMCluster", jobs: int) -> str | None:
    """Submit jobs; unlike `scale` it tells why Slurm does not take them."""
    from distributed import Status  # noqa: PLC0415  an extra

    for _ in range(jobs):
        slurm.worker_spec.update(slurm.new_worker_spec())
    try:
        await slurm
    except (RuntimeError, ValueError) as error:
        for job in slurm.workers.values():
            job.status = Status.failed  # Dask cannot close what it believes to be on its way
        return str(error).rpartition("stderr:")[2].strip()
    return None


def _run_there(work: Work, case: Case, here: str) -> Outcome:
    """What a worker of a cluster does. Raises ClusterError."""
    if code() != here:
        raise ClusterError(f"{socket.gethostname()}: another kantor; install the same everywhere")
    return work(case)


def _collected(future: "Future", address: str) -> Outcome:
    """What came of a case on a cluster. Raises ClusterError."""
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
    except Exception as error:  # noqa: BLE001  whatever Dask makes of a run that fails
        if future.status != "error":  # the run itself is well; what came of it cannot be had
            raise ClusterError(f"{address}: the scheduler is gone") from None
        outcome = Outcome(failed=reason(error))
    return outcome
