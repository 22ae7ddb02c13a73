"""A Docker engine, and fleets in its containers that are gone afterwards."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from kantor_fleet.processes.compose import ComposeConfig, prepare, text
from kantor_fleet.security.authority import Wanted, issue, today
from support.limits import EVENT_LIMIT_S

ROOT = Path(__file__).parents[2]
IMAGE = "kantor-test"
BASE = "python:3.11-slim-bookworm"
_PACKAGES = ("docker.io", "docker-compose", "debootstrap")


class NoEngineError(RuntimeError):
    """No engine runs, and none can be started here; the message says why."""


def call(*command: object, folder: Path = ROOT, **environment: str) -> str:
    """The output of a command; fails with the end of it."""
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}: {(done.stdout + done.stderr)[-2000:]}"
    return done.stdout.strip()


@contextlib.contextmanager
def an_engine() -> Iterator[None]:
    """The engine that runs, or one that is started and stopped again. Raises NoEngineError."""
    if _answers():
        yield
        return
    _install()
    with Path(f"{tempfile.mkdtemp()}/dockerd.log").open("w", encoding="utf-8") as log:
        engine = subprocess.Popen(["dockerd"], stdout=log, stderr=log, start_new_session=True)
        try:
            give_up = time.monotonic() + EVENT_LIMIT_S
            while not _answers():
                if engine.poll() is not None or time.monotonic() > give_up:
                    raise NoEngineError(f"dockerd does not come up; see {log.name}")
                time.sleep(0.2)  # it sends no event
            yield
        finally:
            engine.terminate()
            engine.wait(EVENT_LIMIT_S)


def _answers() -> bool:
    if shutil.which("docker") is None:
        return False
    asked = subprocess.run(["docker", "info"], capture_output=True, check=False)
    return asked.returncode == 0 and b"Server Version" in asked.stdout


def _install() -> None:
    if shutil.which("dockerd") and shutil.which("debootstrap") and compose_command(or_none=True):
        if os.getuid() != 0:
            raise NoEngineError("no Docker engine runs, and only root can start one")
        return
    if os.getuid() != 0 or shutil.which("apt-get") is None:
        raise NoEngineError("no Docker engine runs; installing one needs root and apt-get")
    quiet = {"DEBIAN_FRONTEND": "noninteractive"}
    try:
        call("apt-get", "update", "-qq", **quiet)
        call(
            "apt-get",
            "install",
            "-qq",
            "-y",
            "--no-install-recommends",
            *_PACKAGES,
            "iptables",
            **quiet,
        )
    except AssertionError as error:
        raise NoEngineError(f"no Docker engine, and none can be installed: {error}") from None


def compose_command(*, or_none: bool = False) -> list[str]:
    """Compose v2 if there is one, docker-compose otherwise."""
    plugin = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
    if plugin.returncode == 0:
        return ["docker", "compose"]
    if shutil.which("docker-compose"):
        return ["docker-compose"]
    if or_none:
        return []
    raise NoEngineError("neither `docker compose` nor docker-compose is there")


class Fleet:
    """A compose project of a test's own."""

    def __init__(self, folder: Path, order: ComposeConfig, **settings: str) -> None:
        self.folder = folder
        self.project = re.sub(r"[^a-z0-9]", "", f"kantor{folder.name}{os.getpid()}".lower())
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "compose.yaml").write_text(text(order), encoding="utf-8")
        prepare(folder)
        keys(folder / "keys", Wanted("kantor", order.robots, order.supervisor))
        self._environment = {
            "COMPOSE_PROJECT_NAME": self.project,
            "KANTOR_IMAGE": IMAGE,
            **{f"KANTOR_{name.upper()}": value for name, value in settings.items()},
        }

    def compose(self, *arguments: object) -> str:
        """A compose command to its end."""
        return call(*compose_command(), *arguments, folder=self.folder, **self._environment)

    def start(self, *arguments: object) -> "subprocess.Popen[str]":
        """A compose command that goes on."""
        return subprocess.Popen(
            [*compose_command(), *map(str, arguments)],
            cwd=self.folder,
            env=os.environ | self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def remove(self) -> None:
        """Remove all that it made, in any state."""
        for name in self.compose("ps", "--quiet").split():
            subprocess.run(["docker", "unpause", name], capture_output=True, check=False)
        self.compose("--profile", "centralized", "down", "--volumes", "--timeout", "1")

    def id(self, service: str) -> str:
        """The id of a service's container."""
        return call(
            "docker", "ps", "--all", "--quiet", "--no-trunc",
            "--filter", f"label=com.docker.compose.project={self.project}",
            "--filter", f"label=com.docker.compose.service={service}",
        )  # fmt: skip

    def inspect(self, service: str) -> dict[str, Any]:
        """The description of a container by the engine."""
        (tree,) = json.loads(call("docker", "inspect", self.id(service)))
        assert isinstance(tree, dict)
        return tree

    def run_folder(self) -> Path:
        """The folder of the only run."""
        (folder,) = (path.parent for path in (self.folder / "runs").glob("*/manifest.json"))
        return folder

    def log(self, service: str) -> str:
        """The log of a service, with the engine's times."""
        return call("docker", "logs", "--timestamps", self.id(service)) if self.id(service) else ""

    def await_log(self, service: str, pattern: str) -> str:
        """The first line of a log with a pattern, once it is there."""
        give_up = time.monotonic() + EVENT_LIMIT_S
        while time.monotonic() < give_up:
            for line in self.log(service).splitlines():
                if re.search(pattern, line):
                    return line
            time.sleep(0.1)  # the engine sends no event
        raise AssertionError(f"{service} never says {pattern!r}: {self.log(service)[-1000:]}")

    def await_state(self, service: str, state: str, key: str = "Status") -> None:
        """Return once a container is in a state."""
        give_up = time.monotonic() + EVENT_LIMIT_S
        while time.monotonic() < give_up:
            now = self.inspect(service)["State"]
            if state in {now[key], now.get("Health", {}).get("Status")}:
                return
            time.sleep(0.1)
        raise AssertionError(f"{service} is never {state}: {self.inspect(service)['State']}")

    def readiness_s(self, service: str) -> float:
        """From the last start of a container to its word that it is on the bus."""
        started = _moment(self.inspect(service)["State"]["StartedAt"])
        said = [line.split()[0] for line in self.log(service).splitlines() if "on the bus" in line]
        return (_moment(said[-1]) - started).total_seconds()


def _moment(text_: str) -> datetime:
    return datetime.fromisoformat(f"{text_[:26].rstrip('Z'):0<26}+00:00")


def keys(folder: Path, wanted: Wanted) -> None:
    """Certificates that the user of the containers can read."""
    issue(folder, wanted, today())
    if os.getuid() == 0:
        call("chown", "-R", "10001:10001", folder)


def resident_mb(process: int) -> float:
    """Memory of a process, the pages that it shares included."""
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    match = re.search(r"VmRSS:\s+(\d+) kB", status)
    assert match is not None
    return int(match[1]) * 1024 / 1e6
