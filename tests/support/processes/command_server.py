"""A process with kantor imported and its kernels loaded, of which every `kantor` command of a test is a fork.

Run as a script, with the number of an open Unix socket. Each request is one message: the arguments, the folder and
the environment of a command, with the file descriptors of its stdout, its stderr and of a pipe for its status. The
pipe carries the process id of the command, and when it has ended its wait status, 4 bytes each.

The fork server of a command is a fork, too; that of a command that starts afresh is started as for users.
"""

import contextlib
import functools
import gc
import importlib
import os
import pickle
import pkgutil
import runpy
import signal
import socket
import struct
import sys
from collections.abc import Callable
from multiprocessing import util
from typing import NamedTuple

STATUS = struct.Struct("<i")
REQUEST_MAX = 1 << 20
_DESCRIPTORS = 256
"""More than a command has open when it starts processes."""


class Request(NamedTuple):
    """A command to run."""

    arguments: list[str]
    folder: str
    environment: dict[str, str]
    afresh: bool
    """Whether Python starts again, as an environment of the command's own may need it."""


def main() -> None:
    """Fork for each request until the socket closes."""
    _load()
    request = _fork_commands(socket.socket(fileno=int(sys.argv[1])))
    if request is not None:
        _run(request)


def _load() -> None:
    import kantor_fleet.cli
    import kantor_fleet.execution.preloaded

    for module in pkgutil.iter_modules(kantor_fleet.cli.__path__, "kantor_fleet.cli."):
        importlib.import_module(module.name)
    for name in ("report.report", "processes.local", "processes.mission", "execution.verify"):
        importlib.import_module(f"kantor_fleet.{name}")
    gc.freeze()


def _fork_commands(requests: socket.socket) -> Request | None:
    """Serve the requests: None at their end; in the fork for a command, its request."""
    signal.signal(
        signal.SIGCHLD, signal.SIG_IGN
    )  # the kernel reaps the forks that wait for commands
    while True:
        content, descriptors, _, _ = socket.recv_fds(requests, REQUEST_MAX, 3)
        if not content:
            return None
        if os.fork() == 0:
            requests.close()
            if _is_command(*descriptors):
                return Request(*pickle.loads(content))
            os._exit(0)
        for descriptor in descriptors:
            os.close(descriptor)


def _is_command(stdout: int, stderr: int, status: int) -> bool:
    """Fork the command: true in it; in its parent false, once it has ended and its status is sent."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    command = os.fork()
    if command == 0:
        os.setsid()
        os.write(status, STATUS.pack(os.getpid()))
        os.dup2(stdout, 1)
        os.dup2(stderr, 2)
    for descriptor in (stdout, stderr):
        os.close(descriptor)
    if command != 0:
        os.write(status, STATUS.pack(os.waitpid(command, 0)[1]))
    os.close(status)
    return command == 0


def _run(request: Request) -> None:
    """Go on as `python -m kantor_fleet`."""
    os.chdir(request.folder)
    if request.afresh:
        command = [sys.executable, "-m", "kantor_fleet", *request.arguments]
        os.execve(sys.executable, command, request.environment)
    os.environ.clear()
    os.environ.update(request.environment)
    sys.path[0] = request.folder
    sys.argv = ["kantor", *request.arguments]
    util.spawnv_passfds = functools.partial(_fork_server, util.spawnv_passfds)
    runpy.run_module("kantor_fleet", run_name="__main__", alter_sys=True)


def _fork_server(
    execute: Callable[[bytes, list[str], list[int]], int],
    path: bytes,
    arguments: list[str],
    descriptors: list[int],
) -> int:
    """Start what multiprocessing needs: its fork server as a fork of this process, all else as it would."""
    script = arguments[-1]
    if "multiprocessing.forkserver" not in script:
        return execute(path, arguments, descriptors)
    process = os.fork()
    if process == 0:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        for descriptor in {*range(3, _DESCRIPTORS)} - {*descriptors}:
            with contextlib.suppress(OSError):
                os.close(descriptor)
        try:
            exec(script, {})
        finally:
            os._exit(0)
    return process


if __name__ == "__main__":
    main()
