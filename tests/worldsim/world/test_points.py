"""Tables of points: what is a header, which column is which, and the line and cell of whatever is wrong."""

import os
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.file_names import name_of
from kantor_worldsim.world.points import COORDINATE_MAX_M, points_in
from support.strategies import examples


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files."""
    return tmp_path_factory.mktemp("points")


def read(folder: Path, text: str) -> list[list[float]]:
    """The points of a CSV file with this text."""
    path = folder / "points.csv"
    path.write_text(text)
    return points_in("samples", str(path)).tolist()


def refusal(folder: Path, text: str) -> str:
    """The error of such a file: one line, without the path in front."""
    with pytest.raises(ScenarioError) as caught:
        read(folder, text)
    place, line = f"samples.file: {folder / 'points.csv'}: ", str(caught.value)
    assert line.startswith(place)
    assert "\n" not in line
    return line.removeprefix(place)


NUMBERS = st.floats(-1e9, 1e9).map(lambda number: float(f"{number:.6g}"))
TABLES = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=8)


@examples(100)
@given(
    points=TABLES,
    more=st.lists(st.sampled_from(["id", "z", "name", "weight"]), unique=True, max_size=3),
    names=st.sampled_from([("x", "y"), ("X [m]", "Y [m]"), ("x_m", "y_m"), ("east", "north")]),
    order=st.randoms(use_true_random=False),
)
def test_columns_are_found_by_their_names(
    folder: Path, points: list[tuple[float, float]], more: list[str], names: tuple[str, str],
    order: random.Random,
) -> None:  # fmt: skip
    """In any order, with any other columns beside them; those need hold no numbers."""
    columns = {names[0]: [x for x, _ in points], names[1]: [y for _, y in points]}
    columns |= {name: ['"a, b"'] * len(points) for name in more}
    keys = list(columns)
    order.shuffle(keys)
    rows = zip(*(columns[key] for key in keys), strict=True)
    text = "\n".join(",".join(map(str, row)) for row in (keys, *rows))

    assert read(folder, text) == [list(point) for point in points]


@examples(100)
@given(points=TABLES, row=st.integers(0, 7), column=st.integers(0, 1),
       slip=st.sampled_from(["12.5O", "1.2.3", "--5", "x7", "", "1_0", "5 m", "nan", "inf", "1e308"]),
       header=st.booleans(), blank=st.integers(0, 3))  # fmt: skip
def test_a_cell_that_is_no_coordinate_is_named(
    folder: Path, points: list[tuple[float, float]], row: int, column: int, slip: str,
    blank: int, *, header: bool,
) -> None:  # fmt: skip
    """In the first row as in any other: the line as an editor counts it, and the cell."""
    cells = [[str(x), str(y)] for x, y in points]
    row %= len(cells)
    cells[row][column] = slip
    lines = ["# surveyed"] * blank + ["x,y"] * header + [",".join(pair) for pair in cells]
    message = refusal(folder, "\n".join(lines) + "\n")

    assert message.startswith(f"line {blank + header + row + 1}, cell {column + 1}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,\n3,4\n", "line 1 ends with a comma; remove it"),
        ("1,2\n3,4,\n", "line 2 ends with a comma; remove it"),
        ("x,y\n1,2\n\n3,4,\n", "line 4 ends with a comma; remove it"),
        ("1,2\n3\n", "line 2 has 1 cell; give two columns, x and y in metres"),
        ("1,2\n3,4,5\n", "line 2 has 3 cells; give two columns"),
        ("1,2,3\n", "line 1 has 3 cells; give two columns"),
        ("x,y,z\n1,2\n", "line 2 has 2 cells, but the first row 3; mend it"),
        ("id,size\n1,2\n", None),
        ("a,b,c\n1,2,3\n", "line 1: no columns x and y among 'a', 'b', 'c'; name two of them so"),
        ("size,x\n1,2\n", "line 1: no columns x and y among 'size', 'x'"),
        ("x,X\n1,2\n", "line 1: two columns are named x; rename one"),
        ("1,5;2,5\n", "line 1 has semicolons; part cells by commas, decimals by points"),
        ("x;y\n1;2\n", "line 1 has semicolons"),
        ('1,2\n3,"4\n5,6\n', "line 2: "),
        ("1e400,1\n", "line 1, cell 1: 1e400: row 1 is not finite; remove it"),
        ("x,y\n1,2\n1,-1e13\n", "line 3, cell 2: -1e+13 m is too far away; stay within 1e+12 m"),
    ],
)
def test_a_table_of_another_form_is_refused(folder: Path, text: str, message: str | None) -> None:
    """With the line, and what to do about it; two columns of unknown names are x and y."""
    if message is None:
        assert read(folder, text) == [[1.0, 2.0]]
    else:
        assert refusal(folder, text).startswith(message)


def test_a_first_row_is_dropped_only_if_it_names_columns(folder: Path) -> None:
    """Thirty-one points are thirty-one points."""
    rows = [f"{i}.5,{i}" for i in range(31)]

    assert len(read(folder, "\n".join(rows))) == 31
    assert len(read(folder, "\n".join(["x,y", *rows]))) == 31


def test_quotes_and_remarks(folder: Path) -> None:
    """A # in quotes is a letter."""
    text = 'name,x,y\n"Tree #4, old",1,2 # surveyed\n"Tree #5","3","4"\n'

    assert read(folder, text) == [[1.0, 2.0], [3.0, 4.0]]


def test_a_table_below_a_folder_whose_name_is_not_utf_8_is_read(tmp_path: Path) -> None:
    """And its name stands in the error as far as it is text."""
    path = tmp_path / os.fsdecode(b"caf\xe9.csv")
    path.write_text("1,2\n")
    assert points_in("samples", name_of(path)).tolist() == [[1.0, 2.0]]

    path.write_text("1,x\n")
    with pytest.raises(ScenarioError, match=r"caf\\udce9\.csv: line 1, cell 2"):
        points_in("samples", name_of(path))


@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e308, -2 * COORDINATE_MAX_M])
def test_an_array_has_the_same_bounds(tmp_path: Path, bad: float) -> None:
    path = tmp_path / "points.npy"
    np.save(path, np.array([[1.0, 2.0], [3.0, bad]]))

    with pytest.raises(ScenarioError, match="row 2 is "):
        points_in("targets", str(path))
