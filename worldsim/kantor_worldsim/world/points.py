"""Tables of points in files: CSV and NPY, two columns of metres.

A table of another form is refused with the line and the cell: a row that is dropped or a column that is mistaken for
another would be a wrong density without a word.
"""

import csv
import io
import math
import re
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from tokenize import TokenError
from typing import IO, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.files.reading import UnreadableError, check, read_text
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.file_names import path_of
from kantor_worldsim.world.pictures import UNREADABLE

Points = npt.NDArray[np.float64]

COORDINATE_MAX_M = 1e12
"""Largest coordinate of a point: its square is far from the largest number, and it is still exact to a millimetre."""
_CSV_BYTES_MAX = 1 << 29
_NPY_BYTES_MAX = 1 << 31
"""More than the most samples of a mission."""


def points_in(key: str, file: str) -> Points:
    """(N, 2) points of a file, x and y in metres. key: names the file in messages. Raises ScenarioError."""
    path = path_of(file)
    place = f"{key}.file: {path}"
    try:
        points = _csv(path) if path.suffix.lower() == ".csv" else _npy(path)
    except UnreadableError as error:
        raise ScenarioError(f"{place}: {error.as_no('table')}") from None
    except _TableError as error:
        raise ScenarioError(f"{place}: {error}") from None
    if points.shape[0] == 0:
        raise ScenarioError(f"{place}: no points in it; give at least one")
    return points


class _TableError(ValueError):
    """A table that holds no points; the message is one line."""


# CSV.


class _Columns(NamedTuple):
    """The columns of a table."""

    width: int
    x: int
    y: int
    header: bool = False
    """Whether the first row has their names."""


def _csv(path: Path) -> Points:
    """Rows of x and y. A first row without numbers names the columns; without one there are two.

    What stands behind a # is a remark.
    """
    lines = io.StringIO(read_text(path, _CSV_BYTES_MAX))
    values = array("d")
    columns: _Columns | None = None
    for line, cells in _rows(map(_without_remark, lines)):
        if columns is None:
            columns = _columns_of(line, cells)
            if columns.header:
                continue
        if len(cells) != columns.width:
            raise _TableError(_of_width(line, cells, columns.width))
        row = len(values) // 2 + 1
        values.append(_number(line, row, cells, columns.x))
        values.append(_number(line, row, cells, columns.y))
    return np.array(values, dtype=np.float64).reshape(-1, 2)


def _without_remark(line: str) -> str:
    """A line up to the first # that is not in quotes."""
    found = _CONTENT.match(line) if "#" in line else None
    return found[0] if found else line


_CONTENT = re.compile(r'(?:[^"#]|"[^"]*+"?)*+')


def _rows(lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not blank, each with the number of its line."""
    reader = csv.reader(lines, skipinitialspace=True, strict=True)
    first = 1
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if cells not in ([], [""]):
                yield first, cells
            first = reader.line_num + 1
    except csv.Error as error:
        raise _TableError(f"line {first}: {error}; mend it") from None


def _columns_of(line: int, cells: list[str]) -> _Columns:
    """The columns, from the first row."""
    if any(";" in cell for cell in cells):
        raise _TableError(f"line {line} has semicolons; part cells by commas, decimals by points")
    if any(map(_is_like_a_number, cells)):
        if len(cells) != 2:
            raise _TableError(_of_width(line, cells, 2))
        return _Columns(2, 0, 1)
    named = {axis: [i for i, cell in enumerate(cells) if _AXES[axis].match(cell)] for axis in _AXES}
    for axis, places in named.items():
        if len(places) > 1:
            raise _TableError(f"line {line}: two columns are named {axis}; rename one")
    if all(named.values()):
        return _Columns(len(cells), named["x"][0], named["y"][0], header=True)
    if len(cells) != 2 or named["x"] == [1] or named["y"] == [0]:
        raise _TableError(
            f"line {line}: no columns x and y among {', '.join(map(repr, cells[:8]))}; name two of them so"
        )
    return _Columns(2, 0, 1, header=True)


_AXES = {
    "x": re.compile(r"(x|east|easting)(?![a-z0-9])", re.IGNORECASE),
    "y": re.compile(r"(y|north|northing)(?![a-z0-9])", re.IGNORECASE),
}
"""Names of columns, with or without a unit."""


def _is_like_a_number(cell: str) -> bool:
    """Whether a cell is a number, or one with a slip of the pen: a name begins with a letter."""
    return bool(re.match(r"[-+.]*\d", cell)) or cell.lower().lstrip("+-") in {
        "nan",
        "inf",
        "infinity",
    }


def _of_width(line: int, cells: list[str], width: int) -> str:
    if len(cells) == width + 1 and not cells[-1]:
        return f"line {line} ends with a comma; remove it"
    counted = "1 cell" if len(cells) == 1 else f"{len(cells)} cells"
    if width == 2:
        return f"line {line} has {counted}; give two columns, x and y in metres"
    return f"line {line} has {counted}, but the first row {width}; mend it"


def _number(line: int, row: int, cells: list[str], column: int) -> float:
    """The number in a cell. row: counts rows of points."""
    cell, place = cells[column], f"line {line}, cell {column + 1}"
    if not cell:
        raise _TableError(f"{place} is empty; give a number")
    try:
        number = float(cell)
    except ValueError:
        number = None
    if number is None or "_" in cell:
        raise _TableError(f"{place}: {cell[:40]!r} is no number; mend it")
    if not math.isfinite(number):
        raise _TableError(f"{place}: {cell[:40]}: row {row} is not finite; remove it")
    if abs(number) > COORDINATE_MAX_M:
        raise _TableError(
            f"{place}: {number:g} m is too far away; stay within {COORDINATE_MAX_M:g} m"
        )
    return number


# NPY.


_NPY_HEADERS = {
    1: np.lib.format.read_array_header_1_0,
    2: np.lib.format.read_array_header_2_0,
}
"""Readers of headers by version; a third version is for names of fields, which points have not."""


def _check_header(file: IO[bytes], file_bytes: int) -> None:
    """Raise ValueError for an array that is larger than its file; room for it would be made before it is read."""
    major, _ = np.lib.format.read_magic(file)
    if major in _NPY_HEADERS:
        shape, _, dtype = _NPY_HEADERS[major](file)
        if not dtype.hasobject and math.prod(shape) * dtype.itemsize > file_bytes:
            raise ValueError(f"the file is too short for an array of shape {shape}")
    file.seek(0)


def _npy(path: Path) -> Points:
    check(path, _NPY_BYTES_MAX)
    try:
        with path.open("rb") as file:  # np.load would also open archives
            _check_header(file, path.stat().st_size)
            table = np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    except (*UNREADABLE, TokenError) as error:
        raise _TableError(f"not a table of x, y: {str(error).splitlines()[0]}") from None
    if table.ndim != 2 or table.shape[1] != 2 or table.dtype.kind not in "fiu":
        raise _TableError(f"shape {table.shape}; give two columns, x and y in metres")
    points = table.astype(np.float64)
    usable = np.isfinite(points) & (np.abs(points) <= COORDINATE_MAX_M)
    bad = np.flatnonzero(~usable.all(axis=1))
    if not bad.size:
        return points
    if not np.isfinite(points[bad[0]]).all():
        raise _TableError(f"row {bad[0] + 1} is not finite; remove it")
    raise _TableError(f"row {bad[0] + 1} is too far away; stay within {COORDINATE_MAX_M:g} m")
