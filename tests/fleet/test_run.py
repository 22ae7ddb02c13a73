"""`kantor run`, `scenarios` and `verify` as a user runs them."""

import json
import os
import shutil
import signal
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest

from support.files import rows_of, wait_until
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import result_of

if TYPE_CHECKING:
    from support.processes.command import Finished, Kantor

RESULT_NAMES = [
    "scenario", "seed", "exchange", "clock", "planner", "merge", "robots", "ticks",
    "finished_tick", "detected", "targets", "detection_rate", "w_ub", "w1_exact", "energy_spent",
    "mass_left", "mass_double_counted", "bytes_per_robot_tick", "deliveries", "drops",
    "out_of_range_refused", "violations", "digest", "wall_s",
]  # fmt: skip
SHORT = ("--set", "limit_s=5")


def in_process(kantor: "Kantor", *arguments: object) -> "Finished":
    """A run in one process."""
    return kantor("run", *arguments, "--exchange", "in-process")


def test_a_run_leaves_its_folder(kantor: "Kantor") -> None:
    """Design, part 7: the files, and the stable names in result.json."""
    finished = in_process(kantor, "fleet")

    (folder,) = kantor.runs()
    result = result_of(folder)
    assert finished.code == 0, finished.err
    assert {path.name for path in folder.iterdir()} == {
        "manifest.json", "metrics.csv", "report.png", "result.json", "run.mcap", "scenario.toml",
    }  # fmt: skip
    assert set(RESULT_NAMES) <= set(result)
    assert (result["ended"], result["violations"], result["record"]) == ("done", 0, "whole")
    assert set(result["w_ub"]) == {"paper", "tight", "final_instant"}
    assert set(result["bytes_per_robot_tick"]) == {"weights", "total"}
    assert (folder / "report.png").read_bytes().startswith(b"\x89PNG")
    assert str(result["digest"]) in finished.out


STORM = """
[[faults]]
kind = "burst"
good_s = 1.0
bad_s = 0.5

[[faults]]
kind = "partition"
shape = "halves"
from_s = 1.0
until_s = 3.0
"""


def test_a_run_under_faults_reports_their_effects(kantor: "Kantor") -> None:
    """Those of the scenario and those of the file; the record holds them, so that it verifies."""
    (kantor.folder / "storm.toml").write_text(STORM)
    own = (
        "--set",
        "faults=[{kind='drop', probability=0.1}, {kind='clog', from_s=4, until_s=4.01}]",
    )
    wide = ("limit_s=5", "radio.range_m=inf")
    finished = in_process(kantor, "fleet", "--chaos", "storm.toml", *own, *wide)

    (folder,) = kantor.runs()
    result = result_of(folder)
    effects = result["faults"]
    assert isinstance(effects, dict)
    assert list(effects) == ["0 drop", "1 clog", "2 burst", "3 partition"]
    assert effects["3 partition"]["dropped"] > 100
    assert result["violations"] == 0
    assert f"fault 0 drop           {effects['0 drop']['dropped']} dropped" in finished.out
    assert kantor("verify", folder).code == 0
    again = in_process(kantor, folder / "scenario.toml")
    assert str(result["digest"]) in again.out


def test_a_run_on_a_map_leaves_its_folder(kantor: "Kantor") -> None:
    """The same files; what was explored in place of the mass; and it verifies."""
    small = ("--set", "map.size_m=[16, 16]", "robots.count=2", "starts.spots=0")
    finished = in_process(kantor, "blank", *small)

    (folder,) = kantor.runs()
    result = result_of(folder)
    assert finished.code == 0, finished.err
    assert isinstance(result["map"], dict)
    assert result["map"]["explored"] == 1.0
    assert set(result["map"]["wtv_final"]) == {"r2", "r4", "r8", "r16", "r32", "r64"}
    assert "explored  100.0 %" in finished.out
    assert "distance " in finished.out
    assert (folder / "metrics.csv").read_text().startswith("tick,time_s,explored,")
    assert (folder / "report.png").read_bytes().startswith(b"\x89PNG")
    assert kantor("verify", folder).code == 0


def test_a_mission_that_is_not_met_exits_with_one(kantor: "Kantor") -> None:
    """The limit cut it."""
    finished = in_process(kantor, "fleet", *SHORT)

    assert finished.code == 1
    assert result_of(kantor.runs()[0])["ended"] == "limit"


@pytest.mark.parametrize("exchange", ["in-process", "lockstep"])
def test_an_exact_distance_comes_when_asked_for_and_changes_nothing(
    kantor: "Kantor", exchange: str
) -> None:
    """In its column at the ticks that were named and at the end; the digest is that without it."""
    small = ("--exchange", exchange, "--set", "energy.points=200", "--set", "samples.count=100")
    without, asked = (
        kantor("run", "paper-centralized", *flags, *small)
        for flags in ((), ("--exact-every", "15"))
    )

    assert (without.code, asked.code) == (0, 0), asked.err
    before, after = (result_of(folder) for folder in kantor.runs())
    assert before["digest"] == after["digest"]
    assert before["w1_exact"] is None
    rows = rows_of(kantor.runs()[1] / "metrics.csv")
    exact = {int(row["tick"]): row["w1_exact"] for row in rows}
    assert {tick for tick, value in exact.items() if value} == {0, 15, 30, 40}
    assert float(exact[40]) == after["w1_exact"]
    assert f"exact {after['w1_exact']:.4g}" in asked.out


@pytest.mark.parametrize("spelling", ["realtime", "wall"])
def test_a_realtime_run_is_recorded_as_wall(kantor: "Kantor", spelling: str) -> None:
    """Both names of the exchange are accepted; records, manifest and result.json keep `wall`."""
    finished = kantor("run", "fleet", "--exchange", spelling, "--speed", 20, *SHORT)

    (folder,) = kantor.runs()
    assert finished.code == 1, finished.err  # the limit cut it
    assert result_of(folder)["exchange"] == "wall"
    assert json.loads((folder / "manifest.json").read_text())["exchange"] == "wall"
    assert kantor("verify", folder).code == 0


@pytest.mark.parametrize("verb", ["run", "worldsim"])
def test_help_names_the_realtime_exchange(kantor: "Kantor", verb: str) -> None:
    """With its former name as an alias."""
    shown = " ".join(kantor(verb, "--help").out.replace("│", " ").split())

    assert "lockstep,realtime,wall}" in shown
    assert "wall is accepted for it" in shown


def test_the_scenario_in_the_folder_runs_again_to_the_same_digest(kantor: "Kantor") -> None:
    """scenario.toml is the resolved scenario, overrides included."""
    in_process(kantor, "paper-decentralized", *SHORT, "--seed", 4)
    first = kantor.runs()[0]
    in_process(kantor, first / "scenario.toml", "--seed", 4, "--out", "again")

    again = next((kantor.folder / "again").iterdir())
    assert result_of(first)["digest"] == result_of(again)["digest"]


def test_verify_confirms_a_run_and_fails_on_one_changed_byte(kantor: "Kantor") -> None:
    """Any byte of the journal, wherever it is."""
    in_process(kantor, "paper-decentralized", *SHORT)
    (folder,) = kantor.runs()
    assert kantor("verify", folder).code == 0
    whole = (folder / "run.mcap").read_bytes()

    for position in (0, 40, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        changed = bytearray(whole)
        changed[position] ^= 1
        (folder / "run.mcap").write_bytes(changed)
        finished = kantor("verify", folder)
        assert finished.code == 1
        assert "FAIL" in finished.out


def test_verify_finds_a_forged_record_behind_a_forged_manifest(kantor: "Kantor") -> None:
    """Executing again needs no digest: a record that another seed made is found out."""
    in_process(kantor, "paper-decentralized", *SHORT, "--seed", 1)
    in_process(
        kantor, "paper-decentralized", "--set", "limit_s=5", "radio.range_m=120", "--seed", 1
    )
    first, second = kantor.runs()
    manifest = json.loads((second / "manifest.json").read_text())
    shutil.copy(first / "run.mcap", second / "run.mcap")
    del manifest["digest"]
    (second / "manifest.json").write_text(json.dumps(manifest))
    assert kantor("verify", second).code == 0, "the record itself is sound"

    data = (second / "run.mcap").read_bytes()
    place = data.rindex(b"limit")
    (second / "run.mcap").write_bytes(data[:place] + b"limut" + data[place + 5 :])

    finished = kantor("verify", second)
    assert finished.code == 1
    assert "executed again" in finished.out


def test_verify_reports_an_opening_from_which_no_run_can_start(kantor: "Kantor") -> None:
    """A damaged opening is a verdict, not a traceback."""
    in_process(kantor, "paper-decentralized", *SHORT)
    (folder,) = kantor.runs()
    data = (folder / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(data.replace(b"<f8", b"=f8", 1))

    finished = kantor("verify", folder)
    assert (finished.code, finished.err) == (1, "")
    assert "FAIL  run.mcap: no run can start from its opening" in finished.out


def test_ctrl_c_leaves_a_valid_partial_record(kantor: "Kantor") -> None:
    """SIGINT ends the mission, closes the record, draws the picture, exits with 130."""
    process = kantor.start("run", "paper-single", "--exchange", "in-process")
    assert process.stdout is not None
    while not process.stdout.readline().startswith("t="):
        pass
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=EVENT_LIMIT_S)

    (folder,) = kantor.runs()
    assert process.returncode == 130
    assert result_of(folder)["ended"] == "interrupted"
    assert (folder / "report.png").exists()
    assert kantor("verify", folder).code == 0


def test_ctrl_c_while_kernels_are_compiled_ends_the_command_at_once(kantor: "Kantor") -> None:
    """SIGINT to the whole group, as a terminal sends it: exit code 130 and no traceback."""
    cache = kantor.folder / "kernels"
    process = kantor.start("run", "fleet", KANTOR_KERNELS=str(cache))
    wait_until(lambda: any(cache.rglob("*.kernel")))
    started = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert process.returncode == 130
    assert "Traceback" not in err
    assert psutil.wait_procs(started, timeout=EVENT_LIMIT_S)[1] == []


def test_a_full_disk_cuts_the_record_and_not_the_mission(kantor: "Kantor") -> None:
    """The run goes on to its end and reports where the record was cut; the written part verifies."""
    arguments = ["run", "fleet", "--exchange", "in-process"]
    script = (
        "import resource, sys; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000)); "
        "from kantor_fleet.__main__ import main; sys.argv[1:] = " + repr(arguments) + "; main()"
    )
    import subprocess
    import sys

    finished = subprocess.run(
        [sys.executable, "-c", script], cwd=kantor.folder, capture_output=True, text=True,
        timeout=EVENT_LIMIT_S, check=False,
    )  # fmt: skip

    (folder,) = kantor.runs()
    result = result_of(folder)
    assert finished.returncode == 0, finished.stderr
    assert result["ended"] == "done"
    assert str(result["record"]).startswith("cut at t=")
    assert kantor("verify", folder).code == 0


@pytest.mark.parametrize("kind", ["csv", "npy"])
def test_samples_and_targets_come_from_files(kantor: "Kantor", kind: str) -> None:
    """Points of the user's own, found relative to where the command runs."""
    rng = np.random.default_rng(0)
    samples, targets = rng.normal(800, 60, (300, 2)), rng.normal(800, 60, (40, 2))
    for name, points in (("samples", samples), ("targets", targets)):
        if kind == "csv":
            text = "x,y\n" + "\n".join(f"{x},{y}" for x, y in points)
            (kantor.folder / f"{name}.csv").write_text(text)
        else:
            np.save(kantor.folder / f"{name}.npy", points)

    finished = in_process(
        kantor, "fleet", "--set", f"samples.file=samples.{kind}", f"targets.file=targets.{kind}",
        "targets.count=0", "energy.points=750", "energy.steps=750",
    )  # fmt: skip

    result = result_of(kantor.runs()[0])
    assert finished.code == 0, finished.err
    assert result["targets"] == 40
    assert result["detection_rate"] > 0.8


def test_scenarios_are_listed_and_shown(kantor: "Kantor") -> None:
    """What `show` prints is a scenario that runs."""
    listed = kantor("scenarios").out
    shown = kantor("scenarios", "show", "paper-timevarying").out
    (kantor.folder / "mine.toml").write_text(shown)

    assert listed.splitlines()[0].startswith("fleet ")
    assert len(listed.splitlines()) == 12
    assert in_process(kantor, "mine.toml", *SHORT).code == 1


def test_world_sim_that_is_killed_on_its_way_out_leaves_its_run_alone(kantor: "Kantor") -> None:
    """Started again, it finds the mission over: it does nothing, and nothing is lost."""
    from multiprocessing import Pipe

    from kantor_fleet.processes.local import FleetConfig, _be_world_sim
    from kantor_fleet.scenarios.catalog import find

    assert in_process(kantor, "fleet", *SHORT).code == 1
    (folder,) = kantor.runs()
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    config = FleetConfig(find("fleet"), 0, "lockstep", 1.0, folder)
    _be_world_sim(config, "tcp/127.0.0.1:1", folder, kantor.folder / "log", Pipe()[1], True, False)

    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before
