"""A decoder under test, and the one rule that bad input must keep to.

A decoder takes an input and says whether it was taken in (True) or refused (False). It raises for whatever
must not be: another exception than the documented one, a state that a refused message has changed, an
answer that contradicts the input, a kernel that read or wrote beyond its arrays.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from kantor_protocol.scenario.errors import ScenarioError

Decode = Callable[[bytes], bool]


class Corpus(Protocol):
    """A corpus: makes the inputs of a target."""

    def batch(self, name: object, count: int) -> list[bytes]:
        """Return `count` inputs; the same ones for the same name."""
        ...


class Target(NamedTuple):
    """A decoder under test."""

    inputs: Callable[[], Corpus]
    start: Callable[[Path], Decode]
    """Returns a fresh decoder, called at the start of each batch. The folder is for its files."""
    in_kernels: bool = False
    """Whether compiled code reads the bytes: coverage cannot guide the search there."""


def stateless(decode: Decode) -> Callable[[Path], Decode]:
    """A decoder without state."""
    return lambda _folder: decode


def refuses(error: type[Exception], decode: Callable[[bytes], object]) -> Decode:
    """A refused input raises this error, with one line."""

    def attempt(content: bytes) -> bool:
        try:
            decode(content)
        except error as refusal:
            return not _is_one_line(refusal)
        return True

    return attempt


def _is_one_line(refusal: Exception) -> bool:
    text = str(refusal)
    assert text, "a refusal without text"
    assert "\n" not in text or not isinstance(refusal, ScenarioError), "a refusal in two lines"
    return True
