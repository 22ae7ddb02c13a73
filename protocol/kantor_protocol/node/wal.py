"""A participant's write-ahead log on disk: one append-only file (`.diary`), see `recovery.py`.

The file is a magic, then frames: length, CRC32 of everything so far, content. The first frame is the header (run,
initial state), every other one an entry: the skew of the clock (int64, ns), then encoded Inputs. An entry is handed
to the operating system in one write before the step is made, so that it outlives the process. After a power cut the
tail may be missing or wrong; the sound beginning counts. A file of another run, or of none, counts as no log.

A log has one writer. A process that opens it while another process has it (a frozen predecessor, say) does not
continue it: it begins a new one under the same name, and the other process writes to a file that is not read any
more.
"""

import contextlib
import errno
import fcntl
import os
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from kantor_protocol.base.machine import Body
from kantor_protocol.node.recovery import WalContents
from kantor_protocol.storage import private_files
from kantor_protocol.wire.messages import INPUTS_BYTES_MAX, RefusedError, decode_inputs

_MAGIC = b"kantor diary 1\n"
_HEAD = struct.Struct("<II")
_SKEW = struct.Struct("<q")
_ENTRY_BYTES_MAX = _SKEW.size + INPUTS_BYTES_MAX
"""The longest content of a frame."""
_LOCK_S = 0.5
"""Time to wait for the lock: a process that was killed a moment ago may still hold it."""


class _Header(msgspec.Struct, frozen=True, array_like=True):
    run: str
    initial_state: Body


class _SoundPrefix(NamedTuple):
    """The sound beginning of a file."""

    header: _Header
    entries: list[bytes]
    """Encoded inputs."""
    skew_ns: int
    """The skew of the last entry."""
    ends: list[int]
    """Positions in the file at which the header and each entry end."""
    crc: int


class WalFile:
    """The write-ahead log of a participant in one run."""

    def __init__(self, path: Path, run: str) -> None:
        """path: the file, in a folder that exists."""
        self._path = path
        self._run = run
        self._file = -1
        self._end = 0
        self._crc = 0
        self.skew_ns = 0
        """The lead of the clock that the next entry was made by; after `read`, that of the last entry."""

    def read(self) -> WalContents | None:
        """The sound beginning of the log; None if there is none, or another process holds it. Raises OSError."""
        self.close()
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_NOFOLLOW)
        except FileNotFoundError:
            return None
        if not _acquired(self._file):
            self.close()
            return None
        with open(self._file, "rb", closefd=False) as file:
            prefix = _sound_prefix(file.read())
        if prefix is None or prefix.header.run != self._run:
            self.close()
            return None
        self._end, self._crc, self.skew_ns = prefix.ends[-1], prefix.crc, prefix.skew_ns
        os.ftruncate(self._file, self._end)
        return WalContents(prefix.header.initial_state, prefix.entries)

    def reset(self, initial_state: Body) -> None:
        """Discard all entries and begin a new log. Raises OSError, and then the old file is still there."""
        draft = private_files.draft_of(self._path)
        file = private_files.open_draft(self._path)
        try:
            _acquired(file)
            content = msgspec.msgpack.encode(_Header(self._run, initial_state))
            crc = zlib.crc32(_MAGIC)
            frame, crc = _frame(content, crc)
            _write(file, _MAGIC + frame, 0)
            draft.replace(self._path)
        except OSError:
            os.close(file)
            draft.unlink(missing_ok=True)
            raise
        self.close()
        self._file, self._end, self._crc = file, len(_MAGIC) + len(frame), crc

    def append(self, inputs: bytes) -> None:
        """Add an entry that outlives the process. Raises OSError, and then the entry is not there."""
        if len(inputs) > INPUTS_BYTES_MAX:
            raise OSError(errno.EFBIG, f"inputs of {len(inputs)} bytes, and {INPUTS_BYTES_MAX} fit")
        frame, crc = _frame(_SKEW.pack(self.skew_ns) + inputs, self._crc)
        _write(self._file, frame, self._end)
        self._end += len(frame)
        self._crc = crc

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, -1
        if file >= 0:
            os.close(file)


def tear(path: Path, step: int) -> None:
    """Cut a log in the middle of an entry, as a power cut may, so that it lacks the given step.

    If there is no such entry nothing is cut. Raises OSError.
    """
    prefix = _sound_prefix(path.read_bytes())
    if prefix is None:
        return
    kept = max(0, step - prefix.header.initial_state.step - 1)
    if kept < len(prefix.entries):
        os.truncate(path, (prefix.ends[kept] + prefix.ends[kept + 1]) // 2)


def _frame(content: bytes, crc: int) -> tuple[bytes, int]:
    crc = zlib.crc32(content, zlib.crc32(len(content).to_bytes(4, "little"), crc))
    return _HEAD.pack(len(content), crc) + content, crc


def _write(file: int, frame: bytes, place: int) -> None:
    """Write all of it, in one call if there is room, or nothing. Raises OSError."""
    written = 0
    try:
        while written < len(frame):
            written += os.pwrite(file, frame[written:], place + written)
    except OSError:
        with contextlib.suppress(OSError):
            os.ftruncate(file, place)
        raise


def _acquired(file: int) -> bool:
    """Lock the file for this process; False if another process holds the lock for too long. Raises OSError."""
    give_up = time.monotonic() + _LOCK_S
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= give_up:
                return False
            time.sleep(0.01)
        else:
            return True


def _sound_prefix(content: bytes) -> _SoundPrefix | None:
    """The sound beginning of a file; None if not even the header is sound."""
    if not content.startswith(_MAGIC):
        return None
    frames = _frames(content)
    try:
        first, end, crc = next(frames)
        header = msgspec.msgpack.decode(first, type=_Header)
    except (StopIteration, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    entries, ends, skew_ns = [], [end], 0
    for frame, end, frame_crc in frames:
        try:
            decode_inputs(entry := frame[_SKEW.size :])
        except RefusedError:
            break
        (skew_ns,) = _SKEW.unpack_from(frame)
        entries.append(entry)
        ends.append(end)
        crc = frame_crc
    return _SoundPrefix(header, entries, skew_ns, ends, crc)


def _frames(content: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Content of each sound frame, the position of its end, and the CRC up to there."""
    place, crc = len(_MAGIC), zlib.crc32(_MAGIC)
    while place + _HEAD.size <= len(content):
        length, expected = _HEAD.unpack_from(content, place)
        end = place + _HEAD.size + length
        if length > _ENTRY_BYTES_MAX or end > len(content):
            return
        frame = content[place + _HEAD.size : end]
        crc = zlib.crc32(frame, zlib.crc32(length.to_bytes(4, "little"), crc))
        if crc != expected:
            return
        yield frame, end, crc
        place = end
