"""Bad input: one clear line that names the place and the remedy, the right exit code, no traceback."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from support.processes.command import Kantor


def refused(kantor: "Kantor", *arguments: object) -> tuple[int, str]:
    """The exit code and the one line of a command that must be refused."""
    finished = kantor(*arguments)
    assert "Traceback" not in finished.err + finished.out
    lines = [line for line in finished.err.splitlines() if line]
    assert len(lines) == 1, finished.err
    assert kantor.runs() == []
    return finished.code, lines[0]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("radio.rang_m=3", "radio.rang_m: no such key; did you mean range_m?"),
        ("radio.range_m=wide", "radio.range_m: expected `float`, got `str`"),
        ("radio.range_m=-1", "radio.range_m: expected `float` >= 0.0"),
        ("domain.max_m=[nan,9.0]", "domain.max_m[0]: nan is no usable number; set a finite one"),
        ("samples.count=0", "samples.count: expected `int` >= 1"),
        ("planner.name=psychic", "planner.name: 'psychic' is not known; known: transport"),
        ("samples.file=nowhere.csv", "nowhere.csv: no such file"),
        ("targets.file=nowhere.npy", "nowhere.npy: no such file"),
        ("samples.file=points.docx", "points.docx has an unknown kind"),
        ("robots.count=3", "starts.poses_m: 5 given for 3 robots; give one for each or set"),
        ("starts.poses_m=[[1,1],[1,1],[1,1],[1,1],[9999,1]]", "is outside the domain; move it"),
        ("clock.jitter_s=5", "clock.jitter_s: must be below the shortest period"),
        ("radio.drop=1.5", "radio.drop: expected `float` < 1.0"),
        ("radio=3", "radio: expected `object`, got `int`"),
        ("domain.max_m=[1e308,1e308]", "domain.max_m[0]: 1e+308 is no usable number; stay within"),
        ("vehicle.speed_m_s=1e308", "vehicle.speed_m_s: 1e+308 is no usable number; stay within"),
        (".".join("a" * 30000) + "=1", "no key has so many parts"),
    ],
)
def test_a_bad_scenario_value_is_refused_by_name(
    kantor: "Kantor", override: str, message: str
) -> None:
    """`--set` with a value that cannot be run exits with 2 and names the key."""
    code, line = refused(kantor, "run", "fleet", "--exchange", "in-process", "--set", override)

    assert code == 2
    assert message in line


NAV2 = """
image: {image}
resolution: 0.1
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: {free}
"""


def painted(folder: Path, name: str, shade: int, side: int = 60) -> None:
    """A grey picture with a black wall in the middle, which parts it in two."""
    from PIL import Image

    grey = np.full((side, side), shade, dtype=np.uint8)
    grey[:, side // 2] = 0
    Image.fromarray(grey).save(folder / name)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("map={file='nowhere.yaml'}",), "nowhere.yaml: no such file"),
        (("map={file='lost.yaml'}",), "lost.png: no such file"),
        (("map={file='black.png'}",), "no free cell, so nowhere to stand"),
        (("map={file='halves.png'}", "map.resolution_m=0.1", "starts.random=false",
          "starts.poses_m=[[1,1],[5,1],[2,2]]"), "starts.poses_m[1]: (5, 1) cannot be reached"),
        (("starts.random=false", "starts.poses_m=[[0.05,0.05],[1,1],[2,2]]"), "is inside a wall"),
        (("starts.random=false", "starts.poses_m=[[-5,0],[1,1],[2,2]]"), "starts.poses_m[0]"),
        (("map={}",), "map: set either map.file or map.layout"),
        (("map.layout=castle",), "map.layout: 'castle' is not known; known: office, blank"),
        (("planner=transport",), "planner.name: transport explores a density; on a map use"),
        (("energy.points=5",), "map: cannot be joined with a density"),
        (("vehicle=dubins",), "vehicle.name: dubins cannot stop at a wall"),
        (("coordination=centralized", "supervisor.range_m=5"), "supervisor.pose_m: missing"),
    ],
)  # fmt: skip
def test_a_map_that_cannot_be_explored_is_refused(
    kantor: "Kantor", overrides: tuple[str, ...], message: str
) -> None:
    """One line that names the key or the file, exit code 2, and no run folder."""
    (kantor.folder / "lost.yaml").write_text(NAV2.format(image="lost.png", free=0.196))
    painted(kantor.folder, "black.png", 0)
    painted(kantor.folder, "halves.png", 255)
    code, line = refused(kantor, "run", "office", "--exchange", "in-process", "--set", *overrides)

    assert code == 2
    assert message in line


def test_a_map_whose_unknown_cells_become_free_is_warned_of(kantor: "Kantor") -> None:
    """Nav2 writes 205 for unknown; with free_thresh 0.25 that is free. The mission runs all the same."""
    (kantor.folder / "trap.yaml").write_text(NAV2.format(image="trap.png", free=0.25))
    painted(kantor.folder, "trap.png", 205)
    finished = kantor(
        "run", "office", "--exchange", "in-process",
        "--set", "map={file='trap.yaml'}", "robots.count=1", "limit_s=2",
    )  # fmt: skip

    (line,) = finished.err.splitlines()
    assert line.startswith("kantor: warning: map.file: ")
    assert "grey 205" in line
    assert len(kantor.runs()) == 1


def test_a_mission_on_a_density_needs_another_planner(kantor: "Kantor") -> None:
    """A planner on maps has nothing to explore there."""
    code, line = refused(kantor, "run", "fleet", "--set", "planner=burgard")

    assert code == 2
    assert "planner.name: burgard explores a map; add a [map]" in line


def test_faults_that_cannot_apply_are_refused(kantor: "Kantor") -> None:
    """The file and the entry are named."""
    storm = kantor.folder / "storm.toml"
    storm.write_text("[[faults]]\nkind = 'drop'\nprobability = 1\nrobots = ['r9']\n")
    code, line = refused(kantor, "run", "fleet", "--chaos", storm)

    assert code == 2
    assert line == f"kantor: {storm}: faults[0].robots: r9 is not in the team; known: r1 to r5"


def test_an_override_without_a_value_is_refused(kantor: "Kantor") -> None:
    """`--set` wants key=value."""
    assert refused(kantor, "run", "fleet", "--set", "radio") == (
        2,
        "kantor: --set radio: write it as key.sub=value",
    )


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--exact-every", "-1"), "--exact-every -1: give a number of periods"),
        (("--exact-every", "9", "--exchange", "realtime"), "not in realtime"),
        (("--exact-every", "9", "--exchange", "wall"), "not in realtime"),
        (("--exact", "--set", "samples.count=90000"), "--exact: too many points and samples"),
    ],
)
def test_an_exact_distance_out_of_reach_is_refused(
    kantor: "Kantor", flags: tuple[str, ...], message: str
) -> None:
    """It takes seconds and memory, and a realtime mission does not wait."""
    code, line = refused(kantor, "run", "fleet", *flags)

    assert code == 2
    assert message in line


def test_an_unknown_scenario_is_refused_with_the_known_ones(kantor: "Kantor") -> None:
    """A name that is not packaged lists those that are."""
    code, line = refused(kantor, "run", "flet")

    assert code == 2
    assert "flet: no packaged scenario; there are fleet, blank, cityblock, office, paper-" in line


def test_a_missing_scenario_file_is_refused(kantor: "Kantor") -> None:
    """A file that does not exist is named, with where to look."""
    code, line = refused(kantor, "run", "mine.toml")

    assert code == 2
    assert "mine.toml: no such scenario file; `kantor scenarios` lists the packaged ones" in line


def test_a_scenario_that_is_no_toml_is_refused(kantor: "Kantor") -> None:
    """The parser's complaint names file and place."""
    (kantor.folder / "mine.toml").write_text("radio = [")

    code, line = refused(kantor, "run", "mine.toml")

    assert code == 2
    assert "mine.toml: not valid TOML" in line


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 2)), "no points in it"),
        (np.zeros((3, 4)), "give two columns"),
        (np.array([[0.0, 1.0], [np.nan, 0.0]]), "row 2 is not finite"),
        (np.array([{"a": 1}]), "not a table of x, y"),
    ],
)
def test_a_useless_file_of_samples_is_refused(
    kantor: "Kantor", points: np.ndarray, message: str
) -> None:
    """Files are checked before anything is made; nothing in them is ever unpickled."""
    path = kantor.folder / "points.npy"
    np.save(path, points, allow_pickle=True)

    code, line = refused(kantor, "run", "fleet", "--set", f"samples.file={path}")

    assert code == 2
    assert message in line


def test_a_name_of_any_bytes_is_a_name(kantor: "Kantor") -> None:
    """A mission below such a folder leaves a whole record; a missing file is named and leaves none."""
    name = os.fsdecode(b"caf\xe9")
    folder = kantor.folder / name
    folder.mkdir()
    (folder / "p.csv").write_text("800,700\n810,720\n" * 20)
    quick = ("energy.points=20", "energy.steps=20", f"samples.file={name}/p.csv")
    arguments = ("run", "fleet", "--exchange", "in-process", "--set", *quick)
    assert (
        "nowhere.csv: no such file"
        in refused(kantor, *arguments[:-1], f"samples.file={name}/nowhere.csv")[1]
    )

    for out in ("runs", f"{name}/runs"):
        finished = kantor(*arguments, "--out", out)
        assert (finished.code, finished.err) == (0, "")
        (run,) = (kantor.folder / out).iterdir()
        assert (run / "result.json").exists()
        assert kantor("verify", run).code == 0


def test_a_scenario_takes_its_own_file_wherever_the_command_runs(kantor: "Kantor") -> None:
    """Another file of the same name in the current folder is not taken for it."""
    (kantor.folder / "mine").mkdir()
    scenario = kantor("scenarios", "show", "office").out
    text = scenario.replace('layout = "office"', 'file = "m.png"\nresolution_m = 0.1')
    (kantor.folder / "mine" / "s.toml").write_text(text)
    painted(kantor.folder, "m.png", 255)
    painted(kantor.folder / "mine", "m.png", 255, side=50)
    finished = kantor("run", "mine/s.toml", "--exchange", "in-process", "--set", "limit_s=1")

    assert finished.err == ""
    (run,) = kantor.runs()
    assert f'file = "{kantor.folder}/mine/m.png"' in (run / "scenario.toml").read_text()


def test_usage_errors_exit_with_two(kantor: "Kantor") -> None:
    """Values that no run can have."""
    assert refused(kantor, "run", "fleet", "--seed", "-1")[0] == 2
    assert refused(kantor, "run", "fleet", "--speed", "0")[0] == 2
    assert kantor("run", "fleet", "--exchange", "telepathy").code == 2
    assert kantor("dance").code == 2


def test_a_folder_that_cannot_be_made_is_refused(kantor: "Kantor") -> None:
    """`--out` below a file."""
    (kantor.folder / "file").write_text("")

    code, line = refused(kantor, "run", "fleet", "--out", kantor.folder / "file")

    assert code == 2
    assert "file" in line


def test_a_folder_that_is_no_run_cannot_be_verified(kantor: "Kantor", tmp_path: Path) -> None:
    """`kantor verify` names what it misses."""
    code, line = refused(kantor, "verify", tmp_path)

    assert code == 2
    assert "manifest.json: no such file; give a folder that a run left" in line


def test_where_nothing_listens_the_bus_is_unreachable(kantor: "Kantor") -> None:
    """Exit code 4, with what to do, after the time that `--patience` gives."""
    endpoint = "tcp/127.0.0.1:9"
    code, line = refused(kantor, "agent", "r1", "--connect", endpoint, "--patience", "0.2")

    assert code == 4
    assert f"{endpoint}: nothing listens there after 0.2 s; start `kantor worldsim`" in line


def test_an_endpoint_that_is_none_is_refused(kantor: "Kantor") -> None:
    """The message shows the form of an endpoint."""
    code, line = refused(kantor, "agent", "r1", "--connect", "here")

    assert code == 4
    assert "here: not an endpoint; write it as tcp/HOST:PORT" in line
