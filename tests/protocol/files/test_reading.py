"""The guard of files: what is read, and what is refused in one line before it is read."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.files.reading import (
    DEPTH_MAX,
    UnreadableError,
    digest_of,
    is_deep,
    read_bytes,
    read_text,
)
from support.strategies import examples


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files."""
    return tmp_path_factory.mktemp("files")


def refusal(path: Path, bytes_max: int = 100) -> UnreadableError:
    """The error of a file that is not read: one line with its path."""
    with pytest.raises(UnreadableError) as caught:
        read_text(path, bytes_max)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    return caught.value


def test_what_is_no_file_of_bounded_size_is_refused_unread(tmp_path: Path) -> None:
    """A missing file, a folder, a pipe that nobody writes to, a device without end, and one byte too many."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    (tmp_path / "long").write_bytes(b"x" * 101)
    (tmp_path / "full").write_bytes(b"x" * 100)

    assert refusal(tmp_path / "absent").missing
    assert "a folder" in str(refusal(tmp_path))
    assert "a device or a pipe" in str(refusal(tmp_path / "pipe"))
    assert "a device or a pipe" in str(refusal(tmp_path / "zeros"))
    assert "101 bytes, but at most 100" in str(refusal(tmp_path / "long"))
    assert "name" in str(refusal(tmp_path / ("x" * 300))).lower()
    refusal(tmp_path / "a\0b")
    assert read_bytes(tmp_path / "full", 100) == b"x" * 100


@pytest.mark.parametrize("name", ["pipe", "zeros", "absent", "."])
def test_what_is_no_file_has_no_digest(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")

    assert digest_of(tmp_path / name) is None


def test_a_digest_is_of_the_content_alone(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"same")
    (tmp_path / "two").symlink_to(tmp_path / "one")
    (tmp_path / "other").write_bytes(b"sane")

    assert digest_of(tmp_path / "one") == digest_of(tmp_path / "two")
    assert digest_of(tmp_path / "one") != digest_of(tmp_path / "other")


def test_a_text_that_is_not_utf_8_is_refused_with_its_line(folder: Path) -> None:
    """UTF-16 with its mark is read where a format allows it."""
    path = folder / "text"
    path.write_bytes("a\nb\nlänge\n".encode("latin-1"))
    assert "line 3 is not UTF-8; save it as UTF-8" in str(refusal(path))
    path.write_bytes("länge\n".encode("utf-16"))
    assert "line 1 is not UTF-8" in str(refusal(path))
    assert read_text(path, 100, utf_16=True) == "länge\n"


@examples(100)
@given(text=st.text(st.characters(exclude_characters="[]{}\r", exclude_categories=["Cs"])))
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_text_is_the_same_with_any_line_ends_and_with_a_mark(
    folder: Path, text: str, end: str, mark: str
) -> None:
    """As editors on other systems save it."""
    path = folder / "text"
    path.write_bytes((mark + text.replace("\n", end)).encode())

    assert read_text(path) == text.removeprefix("\ufeff" if not mark else "")


@examples(100)
@given(text=st.text(st.sampled_from("[]{}a"), max_size=3 * DEPTH_MAX))
def test_depth_is_the_most_brackets_that_are_open_at_one_place(text: str) -> None:
    """Counted plainly, letter by letter; a bracket that closes nothing opens nothing."""
    depth = deepest = 0
    for letter in text:
        depth = max(0, depth + (letter in "[{") - (letter in "]}"))
        deepest = max(deepest, depth)

    assert is_deep(text) == (deepest > DEPTH_MAX)


def test_a_text_that_is_nested_too_deeply_is_refused(folder: Path) -> None:
    """However short it is, and only then."""
    path = folder / "deep"
    path.write_text("[" * DEPTH_MAX + "]" * DEPTH_MAX)
    assert read_text(path)
    path.write_text("[{" * DEPTH_MAX)
    assert "brackets within one another" in str(refusal(path, 1000))
