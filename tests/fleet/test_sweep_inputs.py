"""Sweeps and the files that they read: a run is known by content, and doubts about a file are told once."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from kantor_fleet.execution.experiment import Case, run_case
from kantor_fleet.execution.pools import pool
from kantor_fleet.sweep.plan import SweepError, plan
from kantor_worldsim.world.inputs import inputs_of
from support.files import rows_of
from support.strategies import mission

if TYPE_CHECKING:
    from support.processes.command import Kantor

YAML = """
image: plan.png
resolution: 0.2
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: {free}
"""
QUICK = ("robots.count=1", "limit_s=2")


def painted(folder: Path, doors: int = 1, grey: int = 254, free: float = 0.196) -> None:
    """A map of two rooms, as YAML and image."""
    plan_ = np.full((40, 40), grey, dtype=np.uint8)
    plan_[:, 20] = 0
    plan_[5 : 5 + doors, 20] = grey
    Image.fromarray(plan_).save(folder / "plan.png")
    (folder / "map.yaml").write_text(YAML.format(free=free))


def digest(*overrides: str, scenario: str = "fleet", chaos: Path | None = None) -> str:
    return plan(scenario, [], "0", overrides, chaos).variants[0].digest


@pytest.mark.parametrize("changed", ["plan.png", "map.yaml"])
@pytest.mark.parametrize("named", ["plan.png", "map.yaml"])
def test_a_run_on_a_map_is_known_by_what_is_in_its_files(
    tmp_path: Path, named: str, changed: str
) -> None:
    """The map file and the image that it names; nothing else in the folder."""
    painted(tmp_path)
    before = digest(f"map.file={tmp_path / named}", scenario="office")
    content = (tmp_path / changed).read_bytes()
    (tmp_path / changed).write_bytes(content)
    assert digest(f"map.file={tmp_path / named}", scenario="office") == before

    (tmp_path / changed).write_bytes(content + b"\n")
    after = digest(f"map.file={tmp_path / named}", scenario="office")
    assert (after != before) == (named in (changed, "map.yaml"))


@pytest.mark.parametrize("key", ["samples", "targets"])
@pytest.mark.parametrize("name", ["points.csv", "field.png"])
def test_a_run_on_a_density_is_known_by_what_is_in_its_files(
    tmp_path: Path, key: str, name: str
) -> None:
    path = tmp_path / name
    path.write_bytes(b"1,2\n")
    before = digest(f"{key}.file={path}")
    path.write_bytes(b"1,3\n")

    assert digest(f"{key}.file={path}") != before


def test_a_run_is_known_by_what_is_in_its_file_of_faults(tmp_path: Path) -> None:
    storm = tmp_path / "storm.toml"
    storm.write_text("[[faults]]\nkind = 'drop'\nprobability = 0.5\n")
    before = digest(chaos=storm)
    storm.write_text("[[faults]]\nkind = 'drop'\nprobability = 0.6\n")

    assert digest(chaos=storm) != before


def test_a_file_that_changes_while_a_sweep_runs_fails_its_run(tmp_path: Path) -> None:
    """A result under the digest of another file would be handed out as that file's."""
    path = tmp_path / "points.csv"
    path.write_text("10,10\n20,20\n")
    scenario = mission(f"samples.file={path}")
    case = Case(scenario, 0, inputs=inputs_of(scenario))
    assert run_case(case).failed is None

    path.write_text("10,10\n20,30\n")
    outcome = run_case(case)
    assert outcome.result is None
    assert outcome.failed == (
        f"samples.file {path} has changed since the sweep began; run it again"
    )


def test_a_sweep_runs_again_on_a_map_that_was_edited(kantor: "Kantor") -> None:
    """The table is that of the new map; the old map's results come back with the old map."""
    tables = []
    for doors in (1, 30, 1):
        painted(kantor.folder, doors)
        finished = kantor(
            "sweep", "office", "--jobs", 1, "--seeds", "0",
            "--set", "map.file=plan.png", "map.resolution_m=0.2", *QUICK,
        )  # fmt: skip
        assert "Traceback" not in finished.err
        (row,) = rows_of(kantor.folder / "sweeps" / "office" / "table.csv")
        tables.append(row)

    assert tables[0] != tables[1]
    assert tables[0] == tables[2]
    assert len((kantor.folder / "sweeps" / "office" / "runs.jsonl").read_text().splitlines()) == 3


def test_a_doubt_about_a_map_is_told_once(kantor: "Kantor") -> None:
    """Not for every seed, nor for every variant that reads the same map."""
    painted(kantor.folder, grey=205, free=0.25)
    finished = kantor(
        "sweep", "office", "--jobs", 1, "--seeds", "0:2", "--vary", "sensor.range_m=2,3",
        "--set", "map.file=map.yaml", *QUICK,
    )  # fmt: skip

    (warning,) = finished.err.splitlines()
    assert warning.startswith(f"kantor: warning: map.file: {kantor.folder}/map.yaml: ")
    assert "grey 205" in warning


# Values.


@pytest.mark.parametrize(
    ("values", "summaries"),
    [
        ('"a,b","c"', ["a,b", "c"]),
        ("'a,b','c'", ["a,b", "c"]),
        ('"a\\",b","c"', ['a",b', "c"]),
        ("'a\\','b'", ["a\\", "b"]),
        ('"[a","b]"', ["[a", "b]"]),
        ('"""a,b""", c', ["a,b", "c"]),
        ("it's,that's", ["it's", "that's"]),
        (' "a" , b ', ["a", "b"]),
    ],
)
def test_a_comma_in_quotes_parts_no_values(values: str, summaries: list[str]) -> None:
    """As in TOML; in the middle of a plain word a quote is a letter."""
    made = plan("fleet", [f"summary={values}"], "0")

    assert [variant.scenario.summary for variant in made.variants] == summaries
    assert [variant.values for variant in made.variants] == [(text,) for text in summaries]


def test_a_comma_in_quotes_in_brackets_parts_no_values() -> None:
    texts = ['[{kind="drop",probability=0.1,from_s=1}]', "[]"]
    made = plan("fleet", [f"faults={','.join(texts)}"], "0")

    assert [len(variant.scenario.faults) for variant in made.variants] == [1, 0]


@pytest.mark.parametrize("values", ['"a,b', "'a", '"a\\"', '[{name="a,b]'])
def test_a_quote_without_its_end_is_refused(values: str) -> None:
    with pytest.raises(SweepError, match="a quote without its end; close it"):
        plan("fleet", [f"summary={values}"], "0")


# Addresses of Dask.


@pytest.mark.parametrize(
    ("address", "problem"),
    [
        ("localhost", "no port in it"),
        ("tcp://localhost", "no port in it"),
        ("localhost:", "no port in it"),
        ("localhost:0", "no port in it"),
        ("localhost:x", "port could not be cast"),
        ("localhost:99999", "port out of range"),
        (":8786", "no host in it"),
        ("", "no host in it"),
        ("tcp://", "no host in it"),
        ("http://localhost:8786", "unknown protocol http"),
        ("localhost:8786/status", "more than a host and a port"),
        ("[::1", "invalid ipv6 url"),
    ],
)
def test_an_address_at_which_nothing_can_be_is_refused_at_once(
    capsys: pytest.CaptureFixture[str], address: str, problem: str
) -> None:
    """One line and exit code 2, before anything is written or connected."""
    with pytest.raises(SystemExit) as ended:
        pool(None, address)

    err = capsys.readouterr().err
    assert ended.value.code == 2
    assert err.startswith(f"kantor: --cluster {address}: {problem}")
    assert "write HOST:PORT" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("address", ["localhost:8786", "tls://10.0.0.1:1", "tcp://[::1]:8786"])
def test_an_address_of_a_host_and_a_port_is_taken(address: str) -> None:
    """Whether a scheduler is there is found out when it is needed."""
    assert callable(pool(None, address))
