"""Names of files: absolute where they were written, whatever folder a command runs in and whatever bytes they are."""

import os
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.file_names import name_of, path_of, rooted
from kantor_protocol.scenario.load import load, parse
from kantor_protocol.scenario.schema import Scenario
from support.missions import ROOMS_MISSION
from support.strategies import SMALL, examples

KEYS = ("samples", "targets")


def scenario_in(folder: Path, text: str = SMALL) -> Path:
    """A scenario's file in a folder of its own."""
    folder.mkdir(exist_ok=True)
    path = folder / "mine.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("key", KEYS)
def test_a_file_beside_the_scenario_is_taken_before_one_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    """Both are there; the scenario's own counts. If it is missing, the other one is not taken for it."""
    given = "" if key == "samples" else "[targets]\nfile = 'p.csv'\n"
    text = SMALL.replace("count = 12", "file = 'p.csv'") if key == "samples" else SMALL + given
    path = scenario_in(tmp_path / "scenarios", text)
    (tmp_path / "p.csv").write_text("1,1\n")
    monkeypatch.chdir(tmp_path)

    for _ in ("without", "with"):
        for name in (path, path.relative_to(tmp_path)):
            assert getattr(load(name), key).file == str(path.parent / "p.csv")
        (path.parent / "p.csv").write_text("2,2\n")


def test_a_file_in_an_override_is_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the scenario has one beside it, and in a whole table."""
    path = scenario_in(tmp_path / "scenarios")
    for folder in (tmp_path, path.parent):
        (folder / "p.csv").write_text("1,1\n")
    monkeypatch.chdir(tmp_path)

    for override in ("samples.file=p.csv", "samples.file='p.csv'", "samples={file='p.csv'}"):
        assert load(path, [override]).samples.file == str(tmp_path / "p.csv")


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    """What is beside the link is looked for there."""
    path = scenario_in(tmp_path / "scenarios", SMALL + "[targets]\nfile = 'link.csv'\n")
    (path.parent / "link.csv").symlink_to(tmp_path / "elsewhere.csv")

    assert load(path).targets.file == str(path.parent / "link.csv")


def test_a_tilde_is_a_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a file and in an override, where a shell leaves it; a home that nobody has is refused."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    path = scenario_in(tmp_path / "scenarios", SMALL + "[targets]\nfile = '~/t.csv'\n")
    scenario = load(path, ["samples.file=~/p.csv"])

    assert scenario.targets.file == str(tmp_path / "home" / "t.csv")
    assert scenario.samples.file == str(tmp_path / "home" / "p.csv")
    with pytest.raises(ScenarioError, match=r"samples\.file: ~nobody-at-all.*: no such home"):
        load(path, ["samples.file=~nobody-at-all/p.csv"])


@pytest.mark.parametrize(
    "written", ["samples.file={}", "samples.file='{}'", "samples={{file='{}'}}"]
)
def test_a_name_that_is_not_utf_8_stays_in_a_scenario_as_a_uri(
    tmp_path: Path, written: str
) -> None:
    """A scenario can be written and sent, and its file is found again."""
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    file = folder / os.fsdecode(b"p\xff.csv")
    path = scenario_in(folder)
    file.write_text("1,1\n")
    scenario = load(path, [written.format(file)])

    assert scenario.samples.file == f"file://{tmp_path}/caf%E9/p%FF.csv"
    assert path_of(scenario.samples.file) == file
    assert parse(to_toml(scenario), "written") == scenario


@examples(200)
@given(parts=st.lists(st.binary(min_size=1, max_size=8), min_size=1, max_size=3))
def test_every_absolute_path_has_a_name_that_is_text(parts: list[bytes]) -> None:
    """And the name stands for that path alone."""
    assume(not any(b"/" in part or b"\0" in part or part in {b".", b".."} for part in parts))
    path = Path("/", *map(os.fsdecode, parts))
    name = name_of(path)

    assert path_of(name) == path
    assert name.encode()
    assert rooted({"map": {"file": name}}, Path("/elsewhere")) == {"map": {"file": name}}


@pytest.mark.parametrize("key", KEYS)
def test_a_name_that_no_file_can_have_is_refused_by_its_key(tmp_path: Path, key: str) -> None:
    path = scenario_in(tmp_path)
    with pytest.raises(ScenarioError, match=f"{key}.file: .*cannot be the name of a file"):
        load(path, [f"{key}.file={'a' * 300}.csv"])


# A map has a file or a layout.


def on_rooms(tmp_path: Path, table: str, *overrides: str) -> Scenario:
    """The mission in rooms with another table of its map."""
    head, _, rest = ROOMS_MISSION.partition("[map]")
    after = rest.partition("\n[")[2]
    text = f"{head}[map]\n{table}\n[{after}"
    return load(scenario_in(tmp_path, text), overrides)


LAYOUT = 'layout = "office"\nsize_m = [20.0, 20.0]\nresolution_m = 0.2\nseed = 7\n'
FILE = 'file = "/maps/a.yaml"\nresolution_m = 0.05\n'


def test_a_layout_gives_way_to_a_file(tmp_path: Path) -> None:
    """With all that describes the layout, unless it is given anew."""
    plain = on_rooms(tmp_path, LAYOUT, "map.file=/maps/b.png").map
    finer = on_rooms(tmp_path, LAYOUT, "map.resolution_m=0.1", "map.file=/maps/b.png").map

    assert plain is not None
    assert finer is not None
    assert (plain.file, plain.layout, plain.size_m, plain.resolution_m, plain.seed) == (
        *("/maps/b.png", None, None, None, 0),
    )
    assert (finer.file, finer.resolution_m) == ("/maps/b.png", 0.1)


def test_a_file_gives_way_to_a_layout(tmp_path: Path) -> None:
    """And its resolution with it."""
    options = on_rooms(tmp_path, FILE, "map.layout=blank").map

    assert options is not None
    assert (options.file, options.layout, options.resolution_m) == (None, "blank", None)


def test_two_overrides_do_not_give_way_to_each_other(tmp_path: Path) -> None:
    """Which of them is meant is not guessed."""
    for table in (LAYOUT, FILE):
        with pytest.raises(ScenarioError, match="map: set either"):
            on_rooms(tmp_path, table, "map.layout=blank", "map.file=/maps/b.png")
