"""The fork server from which the processes of this machine come: it has imported and compiled everything."""

import contextlib
import multiprocessing
import os
from multiprocessing.context import ForkServerContext

_PRELOADED = "kantor_fleet.execution.preloaded"


def fork_server() -> ForkServerContext:
    """The context of processes that start warm and use one core each."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_PRELOADED])
    return context


def await_fork_server() -> None:
    """Return when the fork server is warm: the first time, kernels are compiled for about half a minute.

    Ctrl-C in a terminal reaches the fork server too and ends it, so that this returns at once; a caller
    looks for signals afterwards. A fork server that failed otherwise shows it at the next start of a process.
    """
    process = fork_server().Process()
    with contextlib.suppress(EOFError, OSError):  # the fork server has ended
        process.start()
        process.join()
