"""Work for pools that comes to an end of its own. Worker processes import it."""

import os
import signal

from kantor_fleet.execution.experiment import Case, Outcome

DEADLY_SEED = 3


def die_of_a_seed(case: Case) -> Outcome:
    """One case kills whoever runs it."""
    if case.seed == DEADLY_SEED:
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(worker=str(os.getpid()))


def fail_of_a_seed(case: Case) -> Outcome:
    """One case raises what it may not."""
    if case.seed == DEADLY_SEED:
        raise SystemExit(7)
    return Outcome(worker=str(os.getpid()))
