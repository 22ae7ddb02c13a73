"""One run as a value: a case goes in, an outcome comes out, and nothing else happens.

Cases and outcomes travel between processes and machines.
"""

import functools
import hashlib
import os
import socket
import time
from pathlib import Path

import msgspec

import kantor_agent
import kantor_protocol
import kantor_supervisor
import kantor_worldsim
from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.inputs import InputFile, changes_since
from kantor_worldsim.world.world import WorldSetup

_REASON_LETTERS = 300


class Case(msgspec.Struct, frozen=True):
    """A run before it is run: everything that decides its result."""

    scenario: Scenario
    seed: int
    exact: bool = False
    """Also compute the exact Wasserstein distance at the end."""
    inputs: tuple[InputFile, ...] = ()
    """The files that the scenario is read from, with the contents that the run is known by."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a case: a result, or the reason why there is none."""

    result: Result | None = None
    failed: str | None = None
    """One line."""
    wall_s: float = 0.0
    worker: str = ""
    """HOST:PID of the process that ran it."""


@functools.cache
def code() -> str:
    """Digest of the sources that decide the outcome of a case, a user's own planner among them."""
    digest = hashlib.blake2b(digest_size=16)
    for package in (kantor_protocol, kantor_agent, kantor_supervisor, kantor_worldsim):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def run_case(case: Case) -> Outcome:
    """Run a case in this process, with every checker; any exception becomes its outcome."""
    started = time.monotonic()
    result, failed = None, None
    try:
        result = _run(case)
    except Exception as error:  # noqa: BLE001  a run that fails must not end others
        failed = reason(error)
    return Outcome(
        result=result,
        failed=failed,
        wall_s=time.monotonic() - started,
        worker=f"{socket.gethostname()}:{os.getpid()}",
    )


def reason(error: BaseException) -> str:
    """An exception as one line."""
    text = " ".join(str(error).split())
    line = text if isinstance(error, ScenarioError) else f"{type(error).__name__}: {text}"
    return line.removesuffix(": ")[:_REASON_LETTERS]


def _run(case: Case) -> Result:
    scenario, seed = case.scenario, case.seed
    setup = WorldSetup.of(scenario, seed)
    for change in changes_since(case.inputs):
        raise ScenarioError(f"{change} since the sweep began; run it again")
    recording = Recording(scenario, seed, "in-process", exact_every=0 if case.exact else None)
    play(scenario, seed, setup, [recording.observe])
    return recording.finish()
