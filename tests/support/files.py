"""Files that commands leave: waited for, and read as tables."""

import csv
import time
from collections.abc import Callable
from pathlib import Path

from support.limits import EVENT_LIMIT_S


def wait_until(condition: Callable[[], bool]) -> None:
    """Look until a condition on files holds: a file has no event to wait for."""
    give_up = time.monotonic() + EVENT_LIMIT_S
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.005)


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
