"""`kantor verify`: its options and their checks."""

from pathlib import Path
from typing import Annotated

import tyro


def verify(run: Annotated[Path, tyro.conf.Positional], /) -> int:
    """Check a recorded run, execute it again and compare; exit code 1 if anything differs.

    A deterministic run is executed again from its scenario and seed. A realtime run is replayed robot by
    robot from its recorded inputs.

    Args:
        run: A run folder.
    """
    from kantor_fleet.execution.verify import verify as verify_run  # noqa: PLC0415

    return verify_run(run)
