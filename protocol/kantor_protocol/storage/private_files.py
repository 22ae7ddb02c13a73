"""Files of secrets and of write-ahead logs: readable by their owner only, in folders likewise.

A new content is written as a draft beside the file and takes its place at once. A draft is a new file in every case:
what stands in its place, a link of someone else's for example, is neither followed nor written to.
"""

import os
from errno import ENOTDIR
from pathlib import Path

_FOLDER_MODE = 0o700
_FILE_MODE = 0o600


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, that its owner alone may enter. One that exists stays as it is.

    Raises OSError.
    """
    if folder.is_dir():
        return
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(ENOTDIR, os.strerror(ENOTDIR), str(folder.parent)) from None
    folder.mkdir(mode=_FOLDER_MODE, exist_ok=True)


def draft_of(path: Path) -> Path:
    """The place of this process's draft of a file."""
    return path.with_name(f".{path.name}.{os.getpid()}")


def open_draft(path: Path) -> int:
    """The descriptor of a new, empty draft of a file, for reading and writing. Raises OSError."""
    draft = draft_of(path)
    draft.unlink(missing_ok=True)  # of a process that had this number before
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    return os.open(draft, flags, _FILE_MODE)


def replace(path: Path, content: bytes) -> None:
    """Write a file, whole and durably, or not at all. Raises OSError, and then the old file is still there."""
    draft = draft_of(path)
    try:
        with os.fdopen(open_draft(path), "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
