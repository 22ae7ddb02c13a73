"""The table of a section of the benchmark, and its printing."""

from collections.abc import Sequence
from typing import NamedTuple


class Table(NamedTuple):
    """The measurements of one section."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: tuple[str, ...] = ()
    met: bool = True
    """Whether every target of the section is met."""


def show(table: Table) -> None:
    """Print a table, its columns aligned."""
    widths = [
        max(len(line[i]) for line in (table.head, *table.rows)) for i in range(len(table.head))
    ]
    print(f"\n{table.title}\n")
    for line in (table.head, tuple("-" * width for width in widths), *table.rows):
        print(_aligned(line, widths))
    for note in table.notes:
        print(f"  {note}")


def verdict(*, met: bool) -> str:
    """The outcome of a target in one word."""
    return "ok" if met else "MISS"


def _aligned(line: Sequence[str], widths: Sequence[int]) -> str:
    """A line with its first column aligned to the left and numbers to the right."""
    first, *rest = (
        cell.rjust(width) if i else cell.ljust(width)
        for i, (cell, width) in enumerate(zip(line, widths, strict=True))
    )
    return "  ".join((first, *rest)).rstrip()
