"""Files of secrets and of write-ahead logs: for their owner only, and never written through what another has put there."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from kantor_protocol.storage import private_files
from kantor_protocol.transport import credentials


@pytest.fixture(autouse=True)
def open_mask() -> Iterator[None]:
    """The process masks no rights."""
    before = os.umask(0)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    """The rights on a file or a folder."""
    return path.stat().st_mode & 0o777


def test_credentials_and_their_folder_are_private(tmp_path: Path) -> None:
    """A folder that is made has 0700, every file 0600."""
    folder = tmp_path / "credentials"
    credentials.issue(folder, "kantor", ["r1"])

    assert mode(folder) == 0o700
    assert {mode(path) for path in folder.iterdir()} == {0o600}


@pytest.mark.parametrize("target", ["other", "nowhere", "."])
def test_a_draft_is_never_what_stood_in_its_place(tmp_path: Path, target: str) -> None:
    """A link of someone else's to a file, to none, or to a folder."""
    path, other = tmp_path / "secret", tmp_path / "other"
    other.write_bytes(b"theirs")
    other.chmod(0o666)
    private_files.draft_of(path).symlink_to(tmp_path / target)
    private_files.replace(path, b"ours")

    assert (path.read_bytes(), mode(path), path.is_symlink()) == (b"ours", 0o600, False)
    assert other.read_bytes() == b"theirs"
    assert sorted(found.name for found in tmp_path.iterdir()) == ["other", "secret"]


def test_a_file_with_more_rights_is_replaced_by_a_private_one(tmp_path: Path) -> None:
    """What had been written there before decides nothing."""
    path = tmp_path / "secret"
    path.write_bytes(b"old")
    path.chmod(0o644)
    private_files.replace(path, b"new")

    assert (path.read_bytes(), mode(path)) == (b"new", 0o600)
