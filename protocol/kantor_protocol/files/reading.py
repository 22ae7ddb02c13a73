"""The guard of files: regular ones of bounded size, and for texts their encoding and their nesting."""

import codecs
import hashlib
import re
import stat
from pathlib import Path

TEXT_BYTES_MAX = 1 << 20
"""Largest text that configures something: a thousand faults, or the identities of a thousand robots, take less."""
DEPTH_MAX = 64
"""Brackets that may be open at one place of a text."""

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_BRACKETS = re.compile(r"[\[\]{}]")


class UnreadableError(ValueError):
    """A file that cannot be read; the message is one line with the path."""

    def __init__(self, path: Path, problem: str, *, missing: bool = False) -> None:
        super().__init__(f"{path}: {problem}")
        self.problem = problem
        """The message without the path."""
        self.missing = missing
        """Whether there is no such file."""

    def as_no(self, kind: str) -> str:
        """The message without the path, for a file that should have been of a kind."""
        return self.problem if self.missing else f"not a readable {kind}: {self.problem}"


class NotTextError(UnreadableError):
    """A file whose content is no text that is read."""


def check(path: Path, bytes_max: int) -> None:
    """Check that a path is a regular file of at most so many bytes. Raises UnreadableError.

    Devices and pipes have no end, or none yet.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise UnreadableError(path, "no such file", missing=True) from None
    except (OSError, ValueError) as error:  # a name that no file can have is a ValueError
        raise UnreadableError(path, _reason(error)) from None
    if stat.S_ISDIR(found.st_mode):
        raise UnreadableError(path, "it is a folder; give a file")
    if not stat.S_ISREG(found.st_mode):
        raise UnreadableError(path, "it is a device or a pipe; save its content to a file")
    if found.st_size > bytes_max:
        raise UnreadableError(
            path, f"{found.st_size} bytes, but at most {bytes_max} are read; give a smaller file"
        )


def read_bytes(path: Path, bytes_max: int) -> bytes:
    """The content of a regular file of at most so many bytes. Raises UnreadableError."""
    check(path, bytes_max)
    try:
        with path.open("rb") as file:
            return file.read(bytes_max)
    except FileNotFoundError:
        raise UnreadableError(path, "no such file", missing=True) from None
    except OSError as error:
        raise UnreadableError(path, _reason(error)) from None


def read_text(path: Path, bytes_max: int = TEXT_BYTES_MAX, *, utf_16: bool = False) -> str:
    r"""The text of a file, in which every line ends with \n. Raises UnreadableError.

    It is UTF-8, with or without a byte order mark; or else UTF-16 with one, if the format allows that.
    """
    content = read_bytes(path, bytes_max)
    wide = utf_16 and content.startswith(_UTF_16)
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise NotTextError(path, f"line {line} is not UTF-8; save it as UTF-8") from None
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if is_deep(text):
        raise NotTextError(path, f"{TOO_DEEP}; write it flatter")
    return text


TOO_DEEP = f"more than {DEPTH_MAX} brackets within one another"


def is_deep(text: str) -> bool:
    """Whether more brackets are open at one place than parsers that call themselves can follow."""
    if text.count("[") + text.count("{") <= DEPTH_MAX:
        return False
    depth = 0
    for bracket in _BRACKETS.finditer(text):
        depth = max(0, depth + (1 if bracket[0] in "[{" else -1))
        if depth > DEPTH_MAX:
            return True
    return False


def digest_of(path: Path) -> str | None:
    """BLAKE2b of the content of a regular file, hexadecimal; None if it cannot be read."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=32)).hexdigest()
    except (OSError, ValueError):
        return None


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
