"""What a process lets go of, and what still works then."""

import subprocess
import sys

import pytest

_SCRIPT = """
import re
from pathlib import Path

import numpy as np
from numba import njit
from kantor_protocol.node.memory_trim import release_file_pages

def resident_kb():
    return int(re.search(r"RssFile:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])

def compiled(n):
    @njit
    def kernel(x):
        return np.sort(x * n).sum()
    return kernel

first = compiled(1)
assert first(np.arange(4.0)) == 6.0
before = resident_kb()
release_file_pages()
print(before - resident_kb())
assert first(np.arange(4.0)) == 6.0
assert compiled(2)(np.arange(4.0)) == 12.0
release_file_pages()
assert compiled(3)(np.arange(4.0)) == 18.0
"""


@pytest.mark.processes
def test_file_pages_are_released_and_come_back_when_used() -> None:
    """Tens of megabytes are not resident any more; what is compiled runs, and the next compiles."""
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT], capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20_000
