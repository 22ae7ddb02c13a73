"""The `kantor` command as processes of their own: run to the end, or started and waited for."""

import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, NamedTuple

from support.limits import EVENT_LIMIT_S
from support.processes.command_server import STATUS, Request


class Finished(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


class Process:
    """A command that runs, with the methods of `subprocess.Popen` that tests need."""

    def __init__(self, status: int, stdout: IO[str], stderr: IO[str]) -> None:
        """status: a pipe, see `command_server`."""
        self._status = status
        self.stdout, self.stderr = stdout, stderr
        self.pid = self._next(EVENT_LIMIT_S)
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while the process runs."""
        return (
            self.returncode if self.returncode is not None or not self._ended(0.0) else self.wait()
        )

    def wait(self, timeout: float | None = EVENT_LIMIT_S) -> int:
        """Wait for the end; the exit code. Raises subprocess.TimeoutExpired."""
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(self._next(timeout))
            os.close(self._status)
        return self.returncode

    def communicate(self, timeout: float = EVENT_LIMIT_S) -> tuple[str, str]:
        """Wait for the end and return what is left of stdout and stderr. Raises subprocess.TimeoutExpired."""
        give_up = time.monotonic() + timeout
        rest = ["", ""]

        def read(index: int, stream: IO[str]) -> None:
            with stream:
                rest[index] = stream.read()

        streams = [stream for stream in (self.stdout, self.stderr) if not stream.closed]
        readers = [
            threading.Thread(target=read, args=item, daemon=True) for item in enumerate(streams)
        ]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(max(0.0, give_up - time.monotonic()))
        self.wait(max(0.0, give_up - time.monotonic()))
        return rest[0], rest[1]

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def _ended(self, timeout: float | None) -> bool:
        return bool(select.select([self._status], [], [], timeout)[0])

    def _next(self, timeout: float | None) -> int:
        if not self._ended(timeout):
            raise subprocess.TimeoutExpired("kantor", timeout or 0.0)
        return int(STATUS.unpack(os.read(self._status, STATUS.size))[0])


class CommandServer:
    """The process of which commands are forks: they need not import and load everything again."""

    def __init__(self) -> None:
        self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        script = Path(__file__).with_name("command_server.py")
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, str(script), str(theirs.fileno())],
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
                pass_fds=[theirs.fileno()],
            )

    def start(self, request: Request) -> Process:
        """Start a command."""
        (out, stdout), (err, stderr), (status, sender) = os.pipe(), os.pipe(), os.pipe()
        content = pickle.dumps(tuple(request))
        socket.send_fds(self._requests, [content], [stdout, stderr, sender])
        for descriptor in (stdout, stderr, sender):
            os.close(descriptor)
        streams = (os.fdopen(pipe, errors="surrogateescape") for pipe in (out, err))
        return Process(status, *streams)

    def close(self) -> None:
        """End the server."""
        self._requests.close()
        self._process.wait(EVENT_LIMIT_S)


class Kantor:
    """Runs the `kantor` command in a folder of its own."""

    def __init__(self, folder: Path, server: CommandServer) -> None:
        self.folder = folder
        self._server = server
        self._started: list[Process] = []

    def __call__(self, *arguments: object, **environment: str) -> Finished:
        """Run to the end."""
        process = self.start(*arguments, **environment)
        out, err = process.communicate(timeout=EVENT_LIMIT_S)
        return Finished(process.returncode or 0, out, err)

    def start(self, *arguments: object, **environment: str) -> Process:
        """Start and go on. A command with an environment of its own starts from nothing."""
        whole = os.environ | {"NO_COLOR": "1", "COLUMNS": "120"} | environment
        request = Request([*map(str, arguments)], str(self.folder), whole, bool(environment))
        self._started.append(self._server.start(request))
        return self._started[-1]

    def runs(self) -> list[Path]:
        """The run folders that commands left, oldest first."""
        return sorted((self.folder / "runs").glob("*"))

    def stop_all(self) -> None:
        """End whatever is left, with all that it started."""
        for process in self._started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate(timeout=EVENT_LIMIT_S)
