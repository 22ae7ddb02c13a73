"""Diaries on disk: whole, cut, altered, of another run, on a full disk, with another process at them."""

import multiprocessing
import os
import resource
import signal
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import Body, Envelope, Inputs, Observation, Outputs, Pose
from kantor_protocol.node.recovery import RecoverableNode, WalContents
from kantor_protocol.node.wal import _MAGIC, WalFile, _frame, tear
from kantor_protocol.storage import private_files
from kantor_protocol.wire.messages import INPUTS_BYTES_MAX, encode
from support.strategies import INPUTS, examples

INITIAL_STATE = Body(Pose(1.0, 2.0), step=3, energy_spent=2, incarnation=1)


def entry(step: int) -> bytes:
    """What is noted before the step after this one."""
    return encode(Inputs(step * 10, Observation(step, Pose(float(step), 0.0))))


ENTRIES = [entry(step) for step in range(3, 9)]


def written(path: Path, entries: list[bytes], run: str = "run") -> None:
    """A write-ahead log that another process left."""
    wal = WalFile(path, run)
    wal.reset(INITIAL_STATE)
    for content in entries:
        wal.append(content)
    wal.close()


def found(path: Path, run: str = "run") -> WalContents | None:
    """The contents that the next process finds."""
    wal = WalFile(path, run)
    entries = wal.read()
    wal.close()
    return entries


@given(st.lists(INPUTS, max_size=6))
@examples(30)
def test_what_is_noted_is_read(inputs: list[Inputs]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "r1.diary"
        written(path, [encode(given_) for given_ in inputs])

        assert found(path) == WalContents(INITIAL_STATE, [encode(given_) for given_ in inputs])


def test_a_log_is_continued_where_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "r1.diary"
    written(path, ENTRIES[:2])
    again = WalFile(path, "run")
    again.read()
    again.skew_ns = -7
    again.append(ENTRIES[2])
    again.close()

    last = WalFile(path, "run")
    assert last.read() == WalContents(INITIAL_STATE, ENTRIES[:3])
    assert last.skew_ns == -7


@given(st.data())
@examples(200)
def test_any_cut_and_any_flipped_bit_leave_a_prefix(data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "r1.diary"
        written(path, ENTRIES)
        content = bytearray(path.read_bytes())
        bit = data.draw(st.integers(0, 8 * len(content) - 1) | st.none())
        if bit is not None:
            content[bit // 8] ^= 1 << bit % 8
        tail = data.draw(st.binary(max_size=20))
        path.write_bytes(content[: data.draw(st.integers(0, len(content)))] + tail)

        first = found(path)
        assert first is None or (first.initial_state, first.inputs) == (
            INITIAL_STATE,
            ENTRIES[: len(first.inputs)],
        )
        assert found(path) == first


@given(st.binary(max_size=300))
@examples(200)
def test_no_other_file_is_taken_for_a_log(content: bytes) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "r1.diary"
        path.write_bytes(content)
        assert found(path) is None
        path.write_bytes(b"kantor diary 1\n" + content)
        assert found(path) is None


@pytest.mark.parametrize(
    "header", [b"", b"\xc1", b"\x92\xa1\xff\x90", b"\x91" * 5000, b"\x92\xa0\xc0"]
)
def test_a_header_that_says_nothing_is_no_header(tmp_path: Path, header: bytes) -> None:
    """Its checksum is right."""
    path = tmp_path / "r1.diary"
    frame, _ = _frame(header, zlib.crc32(_MAGIC))
    path.write_bytes(_MAGIC + frame)
    assert found(path) is None


def test_a_cut_log_is_continued_after_its_last_sound_entry(tmp_path: Path) -> None:
    path = tmp_path / "r1.diary"
    written(path, ENTRIES[:3])
    with path.open("ab") as file:
        file.truncate(path.stat().st_size - 3)
    again = WalFile(path, "run")
    again.read()
    again.append(ENTRIES[4])
    again.close()

    assert found(path) == WalContents(INITIAL_STATE, [*ENTRIES[:2], ENTRIES[4]])


def test_a_log_of_another_run_or_of_none_is_discarded(tmp_path: Path) -> None:
    path = tmp_path / "r1.diary"
    assert found(path) is None
    written(path, ENTRIES, run="yesterday's")
    assert found(path) is None
    written(path, ENTRIES[:1])
    assert found(path) == WalContents(INITIAL_STATE, ENTRIES[:1])
    assert [file.name for file in tmp_path.iterdir()] == ["r1.diary"]


@pytest.mark.parametrize(("step", "left"), [(9, 5), (8, 4), (4, 0), (3, 0), (12, 6)])
def test_torn_it_lacks_a_step_and_ends_in_the_middle_of_an_entry(
    tmp_path: Path, step: int, left: int
) -> None:
    path = tmp_path / "r1.diary"
    written(path, ENTRIES)
    whole = path.stat().st_size
    tear(path, step)

    assert (path.stat().st_size == whole) == (left == len(ENTRIES))
    assert found(path) == WalContents(INITIAL_STATE, ENTRIES[:left])
    tear(path, 0)
    tear(path, 0)
    assert found(path) == WalContents(INITIAL_STATE, [])


def found_beside(path: Path) -> list[bytes]:
    """The entries in a log that is still being written."""
    copy = path.with_name("copy")
    copy.write_bytes(path.read_bytes())
    entries = found(copy)
    return [] if entries is None else list(entries.inputs)


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file may grow beyond a size, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("spare", [0, 1, 9, 30])
def test_a_full_disk_takes_no_entry_and_no_half_of_one(tmp_path: Path, spare: int) -> None:
    """The entry is refused with an error, and fits when there is room again."""
    path = tmp_path / "r1.diary"
    wal = WalFile(path, "run")
    wal.reset(INITIAL_STATE)
    wal.append(ENTRIES[0])
    with room_for(path.stat().st_size + spare), pytest.raises(OSError, match="File too large"):
        wal.append(ENTRIES[1])
    assert found_beside(path) == ENTRIES[:1]
    wal.append(ENTRIES[1])
    wal.append(ENTRIES[2])
    wal.close()

    assert found(path) == WalContents(INITIAL_STATE, ENTRIES[:3])


def test_a_full_disk_keeps_the_old_log_when_a_new_one_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "r1.diary"
    written(path, ENTRIES[:1])
    wal = WalFile(path, "run")
    with room_for(20), pytest.raises(OSError, match="File too large"):
        wal.reset(INITIAL_STATE)

    assert found(path) == WalContents(INITIAL_STATE, ENTRIES[:1])
    assert [file.name for file in tmp_path.iterdir()] == ["r1.diary"]


class Counter:
    """A machine that counts its steps."""

    def __init__(self, body: Body) -> None:
        self._step = body.step

    def step(self, inputs: Inputs, /) -> Outputs:
        self._step += 1
        return Outputs(self._step, inputs.observation.pose)


def keep_frozen(path: Path, ready: Callable[[], None]) -> None:
    """A predecessor that was stopped in the middle of its steps."""
    node = RecoverableNode(Counter, WalFile(path, "run"), Body(Pose(0.0, 0.0)))
    node.step(Inputs(1, Observation(0, Pose(0.0, 0.0))))
    ready()
    signal.pause()


def test_two_writers_never_share_a_log(tmp_path: Path) -> None:
    """A frozen predecessor has the file: its successor is a new incarnation with a file of its own."""
    path = tmp_path / "r1.diary"
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    frozen = context.Process(target=keep_frozen, args=(path, ready.set))
    frozen.start()
    assert ready.wait(60)
    try:
        body = Body(Pose(0.0, 0.0), step=1)
        successor = RecoverableNode(Counter, WalFile(path, "run"), body)
        assert (successor.incarnation, successor.step_count) == (1, 1)
        os.kill(frozen.pid or 0, signal.SIGKILL)
        frozen.join()
        successor.step(Inputs(2, Observation(1, Pose(0.0, 0.0))))
        third = RecoverableNode(Counter, WalFile(path, "run"), body)
        assert (third.incarnation, third.step_count) == (1, 1)
    finally:
        frozen.kill()
        frozen.join()


# Bounds, and who may read it.


@given(excess=st.integers(-3, 3))
@examples(7)
def test_what_cannot_be_read_is_not_written(excess: int) -> None:
    """One limit for both: an entry of that length is found again, and a longer one is refused, and the log goes on."""
    small = ENTRIES[0]
    envelope = Envelope("r2", 1, "", b"")
    bare = len(encode(Inputs(1, Observation(3, Pose(0.0, 0.0)), (envelope,))))
    # A longer body has a longer head: 3 bytes more than that of an empty one.
    body = bytes(INPUTS_BYTES_MAX - bare - 3 + excess)
    long = encode(Inputs(1, Observation(3, Pose(0.0, 0.0)), (Envelope("r2", 1, "", body),)))
    assert len(long) == INPUTS_BYTES_MAX + excess
    with TemporaryDirectory() as folder:
        path = Path(folder) / "r1.diary"
        wal = WalFile(path, "run")
        wal.reset(INITIAL_STATE)
        wal.append(small)
        if excess > 0:
            with pytest.raises(OSError, match="bytes, and"):
                wal.append(long)
        else:
            wal.append(long)
        wal.append(small)
        wal.close()

        kept = [small] if excess > 0 else [small, long]
        assert found(path) == WalContents(INITIAL_STATE, [*kept, small])


def test_a_log_is_for_its_owner_only(tmp_path: Path) -> None:
    """Whatever the mask of the process is; and a link in the place of the draft is not written through."""
    path, other = tmp_path / "r1.diary", tmp_path / "other"
    other.write_bytes(b"someone else's")
    private_files.draft_of(path).symlink_to(other)
    before = os.umask(0)
    try:
        written(path, ENTRIES)
    finally:
        os.umask(before)

    assert path.stat().st_mode & 0o777 == 0o600
    assert not path.is_symlink()
    assert other.read_bytes() == b"someone else's"
    assert found(path) == WalContents(INITIAL_STATE, ENTRIES)


def test_a_log_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    """The log of another place is neither read nor cut."""
    path, other = tmp_path / "r1.diary", tmp_path / "other"
    written(other, ENTRIES)
    path.symlink_to(other)
    before = other.read_bytes()

    with pytest.raises(OSError, match="symbolic links"):
        found(path)
    assert other.read_bytes() == before
