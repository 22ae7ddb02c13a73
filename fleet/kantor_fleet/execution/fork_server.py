"""The fork server from which the processes of this machine come: it has imported and compiled everything.

No process outlives the command that started it: the fork server ends with the command, and they end with the fork
server, by the kernel's doing. So do those that are stopped, and none needs to be asked.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Any

from kantor_fleet.execution.parent_death import die_with_parent

_DESCRIPTORS = 12
"""More than the start of a process takes."""
_PRELOADED = [f"kantor_fleet.execution.{name}" for name in ("tied", "preloaded", "shielded")]


class StartError(Exception):
    """A process that cannot be started; the message is one line with the remedy."""


def fork_server() -> ForkServerContext:
    """The context of processes that start warm and use one core each."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:  # the tracker ignores the other signals of a terminal by itself
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


def start_process(name: str, target: Callable[..., Any], *arguments: Any) -> ForkServerProcess:
    """Start a process that ends with this one. Raises StartError."""
    # A daemon: one that is left when the command ends is ended, and not waited for.
    process = fork_server().Process(
        target=be_tied, args=(target, *arguments), name=name, daemon=True
    )
    try:
        _check_room()
        process.start()
    except (OSError, EOFError) as error:
        raise _start_error(name, error) from None
    return process


def pipe(name: str) -> tuple[Connection, Connection]:
    """A pipe to the process of this name. Raises StartError."""
    try:
        return fork_server().Pipe()
    except OSError as error:
        raise _start_error(name, error) from None


def _start_error(name: str, error: OSError | EOFError) -> StartError:
    reason = getattr(error, "strerror", None) or str(error) or "the fork server has ended"
    return StartError(
        f"{name}: its process cannot be started ({reason}); "
        "see the limits on processes and open files (`ulimit -a`)"
    )


def _check_room() -> None:
    """Check that a process can be started whole; half a start leaves one that waits. Raises OSError."""
    with contextlib.ExitStack() as stack:
        for _ in range(_DESCRIPTORS):
            stack.callback(os.close, os.open(os.devnull, os.O_RDONLY))


def be_tied(target: Callable[..., Any], *arguments: Any) -> None:
    """Run a target in a process of the fork server's that ends with the command."""
    die_with_parent()
    command = multiprocessing.parent_process()
    if command is not None and not wait([command.sentinel], 0.0):
        target(*arguments)


def await_fork_server(kinds: Sequence[str] = ()) -> None:
    """Return when the fork server is warm: the first time, kernels are compiled for about half a minute.

    kinds: of the only missions that its processes have, see `preload.py`; none: they have all kinds.

    Ctrl-C in a terminal reaches the fork server too and ends it, so that this returns at once; a caller
    looks for signals afterwards. A fork server that failed otherwise shows it at the next start of a process.
    """
    if kinds:
        os.environ["KANTOR_PRELOADED"] = ",".join(kinds)
    process = fork_server().Process()
    with contextlib.suppress(EOFError, OSError):  # the fork server has ended
        process.start()
        process.join()
