"""Work that ends its process. Worker processes import it."""

import os
import signal
from pathlib import Path

from kantor_fleet.execution.experiment import Case, Outcome
from kantor_fleet.processes.log import log_to

DEADLY_SEED = 3


def die_of_a_seed(case: Case) -> Outcome:
    """One case kills the process that runs it."""
    if case.seed == DEADLY_SEED:
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(worker=str(os.getpid()))


def fail_of_a_seed(case: Case) -> Outcome:
    """One case raises an exception that work must not raise."""
    if case.seed == DEADLY_SEED:
        raise SystemExit(7)
    return Outcome(worker=str(os.getpid()))


def crash(_config: object, _listen: str, _identities: object, log: Path, *_more: object) -> None:
    """A world-sim that raises."""
    log_to(log, "worldsim")
    raise RuntimeError("a crash")
