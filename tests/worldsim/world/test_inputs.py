"""The files that a scenario is read from: all of them, each by its content."""

from pathlib import Path

import pytest

from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.inputs import changes_since, inputs_of
from support.missions import on_map
from support.strategies import mission

YAML = """
image: plan.pgm
resolution: 0.5
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a map and points."""
    (tmp_path / "map.yaml").write_text(YAML)
    (tmp_path / "plan.pgm").write_bytes(b"P5\n2 2\n255\n" + b"\xfe" * 4)
    (tmp_path / "points.csv").write_text("1,2\n")
    (tmp_path / "field.png").write_bytes(b"anything")
    return tmp_path


def exploring(folder: Path) -> Scenario:
    return on_map(f"map={{file='{folder}/map.yaml'}}", f"targets.file='{folder}/points.csv'")


def keys_of(scenario: Scenario) -> dict[str, Path]:
    return {file.key: file.path for file in inputs_of(scenario)}


def test_every_file_is_listed_and_the_image_of_a_map_with_it(folder: Path) -> None:
    """By the key that names it."""
    field = mission(f"samples.file={folder}/field.png", "samples.count=3")

    assert keys_of(exploring(folder)) == {
        "map.file": folder / "map.yaml",
        "map.file: image": folder / "plan.pgm",
        "targets.file": folder / "points.csv",
    }
    assert keys_of(field) == {"samples.file": folder / "field.png"}
    assert keys_of(mission()) == {}


@pytest.mark.parametrize("name", ["map.yaml", "plan.pgm", "points.csv"])
def test_a_change_of_any_file_is_told(folder: Path, name: str) -> None:
    """By content: written anew as it was, it has not changed."""
    inputs = inputs_of(exploring(folder))
    path = folder / name
    content = path.read_bytes()
    path.write_bytes(content)
    assert list(changes_since(inputs)) == []

    path.write_bytes(content + b"\n")
    (change,) = changes_since(inputs)
    assert change.endswith(f" {path} has changed")
    path.unlink()
    (change,) = changes_since(inputs)
    assert change.endswith(f" {path} is gone")


def test_a_file_that_cannot_be_read_has_no_digest(folder: Path) -> None:
    """It is listed all the same; a YAML file that is none names no image."""
    (folder / "map.yaml").write_text("image: [")
    (folder / "points.csv").unlink()
    found = {file.key: file.blake2b for file in inputs_of(exploring(folder))}

    assert set(found) == {"map.file", "targets.file"}
    assert found["map.file"] is not None
    assert found["targets.file"] is None
