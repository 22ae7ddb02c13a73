"""Fuzz every decoder: bounded, seeded, each in a process of its own, so that a crash is a finding too.

    python tests/fuzz/fuzz.py [--inputs 1000000] [--only NAME ...] [--seed 0] [--jobs 2]

Prints a line for each decoder. An input that breaks the rule is written to a file, and the command that
repeats it is told; then the exit code is 1.
"""

import argparse
import ctypes
import mmap
import multiprocessing
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from fuzz.decoding import Decode
from fuzz.targets import TARGETS

BATCH = 500
"""Inputs that one state of a decoder sees."""
_WARM_BATCHES = 20
"""By then whatever is compiled, imported or kept once is there."""
_STUCK_S = 300.0
"""No input takes so long, however busy the machine is, and kernels to be compiled."""
INPUT_CPU_S = 10.0
"""What one input may take of the CPU."""
INPUT_BYTES = 512 << 20
"""What one input may add to the peak of memory: the largest image, and room to work on it."""
_ROOM_BYTES = 1 << 30
"""What a decoder may take at any time beyond what it begins with."""
_GROWTH_BYTES = 32 << 20
"""What may stay with it after all its inputs."""
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)
"""glibc's alone."""
_PAGE = struct.Struct("=qq")
"""What a process tells while it runs: batch, and input in it."""


class Failure(NamedTuple):
    """An input that broke the rule."""

    batch: int
    index: int
    """-1: no single one did."""
    why: str
    trace: str = ""


class Tally(NamedTuple):
    """What became of the inputs of a decoder."""

    name: str
    inputs: int
    taken: int
    cpu_s: float
    before_bytes: int
    after_bytes: int
    failure: Failure | None = None


def fuzz(name: str, seed: int, inputs: int, page: Any = None, first: int = 0) -> Tally:
    """Inputs of one decoder in this process, batch by batch, from a batch on."""
    target, page = TARGETS[name], page or bytearray(_PAGE.size)
    inventive = target.inputs()
    done = taken = 0
    before_bytes = held_bytes()
    _begin_peak()
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        started_s = time.process_time()
        for batch in range(first, first + -(-inputs // BATCH)):
            contents = inventive.batch(f"{name} {seed} {batch}", min(BATCH, inputs - done))
            decode = target.start(Path(folder))
            compiling = target.in_kernels and batch == first
            attempt = decode if compiling else partial(within_limits, decode)
            for i, content in enumerate(contents):
                _PAGE.pack_into(page, 0, batch, i)
                try:
                    taken += attempt(content)
                except BaseException as error:  # noqa: BLE001  whatever it is, it is a finding
                    why = f"{type(error).__name__}: {error}".splitlines()[0]
                    failure = Failure(batch, i, why, traceback.format_exc())
                    spent_s = time.process_time() - started_s
                    return Tally(
                        name, done + i, taken, spent_s, before_bytes, held_bytes(), failure
                    )
            done += len(contents)
            if batch - first == _WARM_BATCHES:
                before_bytes = held_bytes()
        spent_s = time.process_time() - started_s
    grown = held_bytes() - before_bytes
    failure = None
    if inputs > 2 * _WARM_BATCHES * BATCH and grown > _GROWTH_BYTES:
        failure = Failure(first, -1, f"{grown >> 20} MiB more than before")
    return Tally(name, done, taken, spent_s, before_bytes, held_bytes(), failure)


class LimitError(Exception):
    """An input that cost more than one may."""


def within_limits(decode: Decode, content: bytes) -> bool:
    """What a decoder makes of an input. Raises LimitError if that took more time or memory than its length explains.

    Time is the CPU's, so that other work on the machine does not count; memory is the peak since the decoder's first input.
    """
    begun_s, before_bytes = time.process_time(), _peak_bytes()
    taken = decode(content)
    spent_s, more_bytes = time.process_time() - begun_s, _peak_bytes() - before_bytes
    if spent_s > INPUT_CPU_S:
        raise LimitError(f"{spent_s:.1f} s for an input of {len(content)} bytes")
    if more_bytes > INPUT_BYTES:
        raise LimitError(f"{more_bytes >> 20} MiB for an input of {len(content)} bytes")
    return taken


def _begin_peak() -> None:
    """The peak of memory is what is held now: that of earlier work would hide what an input takes."""
    with suppress(OSError):  # Linux's alone
        Path("/proc/self/clear_refs").write_text("5")


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def content_of(name: str, seed: int, inputs: int, batch: int, index: int) -> bytes:
    """One of the inputs again."""
    count = min(BATCH, inputs - batch * BATCH) if inputs > batch * BATCH else BATCH
    return TARGETS[name].inputs().batch(f"{name} {seed} {batch}", count)[index]


def held_bytes() -> int:
    """Memory of this process, but for what malloc has free.

    Once a large picture has been freed, glibc takes the next ones from its heap instead of mapping them, and keeps
    up to 64 MiB free at its end (M_MMAP_THRESHOLD in mallopt(3)): where that stands at a moment is chance.
    """
    if _TRIM is not None:
        _TRIM(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _memory() -> str | None:
    """Where files cost no disk."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


# Processes.


def _work(name: str, seed: int, inputs: int, first: int, page: mmap.mmap, told: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with Path(os.devnull).open("w") as nowhere:  # what libtiff has to say
        os.dup2(nowhere.fileno(), sys.stderr.fileno())
    room_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (room_bytes + _ROOM_BYTES,) * 2)
    told.send(fuzz(name, seed, inputs, page, first))


class _Process:
    """A decoder under way."""

    def __init__(self, name: str, seed: int, inputs: int, first: int) -> None:
        self.name = name
        self._page = mmap.mmap(-1, mmap.PAGESIZE)
        self._pipe, told = multiprocessing.Pipe(duplex=False)
        context = multiprocessing.get_context("fork")
        self._process = context.Process(
            target=_work, args=(name, seed, inputs, first, self._page, told)
        )
        self._process.start()
        told.close()
        self._place, self._since_s = b"", time.monotonic()

    def look(self) -> Tally | None:
        """What came of it, if it is over."""
        if self._pipe.poll(0.05):
            try:
                tally: Tally = self._pipe.recv()
            except EOFError:
                self._process.join()
                return self._lost(f"the process died: exit code {self._process.exitcode}")
            self._process.join()
            return tally
        place = self._page[: _PAGE.size]
        if place != self._place:
            self._place, self._since_s = place, time.monotonic()
        if time.monotonic() - self._since_s > _STUCK_S:
            self._process.kill()
            self._process.join()
            return self._lost(f"no end within {_STUCK_S:g} s")
        return None

    def _lost(self, why: str) -> Tally:
        batch, index = _PAGE.unpack_from(self._page)
        return Tally(self.name, batch * BATCH + index, 0, 0.0, 0, 0, Failure(batch, index, why))

    def end(self) -> None:
        """Whatever it is doing."""
        self._process.kill()
        self._process.join()


def fuzz_all(
    names: Sequence[str], seed: int, inputs: int, jobs: int, first: int
) -> Iterator[Tally]:
    """Tallies as they come."""
    left, running = list(reversed(names)), []
    try:
        while left or running:
            while left and len(running) < jobs:
                TARGETS[left[-1]].inputs()  # missions are played once, for all that come after
                running.append(_Process(left.pop(), seed, inputs, first))
            for process in list(running):
                if (tally := process.look()) is not None:
                    running.remove(process)
                    yield tally
    finally:
        for process in running:
            process.end()


# The command.


def main() -> int:
    """Fuzz, and tell."""
    options = _options()
    failed = 0
    print(
        f"{'decoder':<17}{'inputs':>9}{'refused':>9}{'taken':>9}{'inputs/s':>10}  RSS before, after"
    )
    for tally in fuzz_all(options.only, options.seed, options.inputs, options.jobs, options.batch):
        refused, rate = tally.inputs - tally.taken, tally.inputs / max(tally.cpu_s, 1e-9)
        memory = f"{tally.before_bytes / 2**20:.1f} {tally.after_bytes / 2**20:.1f} MiB"
        counts = f"{tally.inputs:>9}{refused:>9}{tally.taken:>9}{rate:>10.0f}"
        print(f"{tally.name:<17}{counts}  {memory}", flush=True)
        if tally.failure is not None:
            failed += 1
            _tell(tally.name, options, tally.failure)
    print("no input broke a rule" if not failed else f"{failed} decoders broke a rule")
    return 1 if failed else 0


def _tell(name: str, options: argparse.Namespace, failure: Failure) -> None:
    seed, (batch, index, why, trace) = options.seed, failure
    print(f"  FAIL {why}")
    if index >= 0:
        options.out.mkdir(exist_ok=True)
        path = options.out / f"{name}-{seed}-{batch}-{index}"
        path.write_bytes(content_of(name, seed, (batch + 1) * BATCH, batch, index))
        if trace:
            path.with_suffix(".txt").write_text(trace)
        print(f"  {path}")
    inputs = index + 1 if index >= 0 else options.inputs
    command = f"--only {name} --seed {seed} --batch {batch} --inputs {inputs}"
    print(f"  python tests/fuzz/fuzz.py {command}", flush=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=1_000_000, help="for each decoder")
    parser.add_argument("--only", nargs="+", choices=sorted(TARGETS), default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0, help="another one, other inputs")
    parser.add_argument("--jobs", type=int, default=2, help="decoders at a time")
    parser.add_argument(
        "--batch", type=int, default=0, help="begin with this one, to repeat a failure"
    )
    parser.add_argument("--out", type=Path, default=Path("fuzz-failures"), help="for bad inputs")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
