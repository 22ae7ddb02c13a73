"""Real processes on the real bus explore unknown maps."""

import os
import signal
from typing import TYPE_CHECKING

import pytest

from support.limits import EVENT_LIMIT_S
from support.processes.fleets import await_line, children_named, result_of

if TYPE_CHECKING:
    from support.processes.command import Kantor

SMALL = ("--set", "map.size_m=[18.0,14.0]", "sensor.range_m=4", "sensor.beams=128")
BAD_RADIO = ("radio.drop=0.1", "radio.duplicate=0.1", "radio.delay_s=0.03", "radio.jitter_s=0.3")


@pytest.mark.parametrize(
    ("coordination", "planner"), [("centralized", "kmeans"), ("decentralized", "market")]
)
def test_same_seed_same_digest_in_process_and_over_the_bus(
    kantor: "Kantor", coordination: str, planner: str
) -> None:
    """Three robots with a range finder, a bad radio, under different hash seeds; verify confirms it."""
    for exchange, hash_seed in (("in-process", "0"), ("lockstep", "123")):
        finished = kantor(
            "run", "office", "--exchange", exchange, *SMALL, *BAD_RADIO,
            f"coordination={coordination}", f"planner={planner}",
            PYTHONHASHSEED=hash_seed,
        )  # fmt: skip
        assert finished.code == 0, finished.out + finished.err

    results = [result_of(folder) for folder in kantor.runs()]
    assert len({result["digest"] for result in results}) == 1
    assert all(result["drops"] > 50 for result in results)
    assert all(result["map"]["explored"] == 1.0 for result in results)
    assert "every byte the same" in kantor("verify", kantor.runs()[-1]).out


def test_robots_in_real_time_explore_the_whole_map(kantor: "Kantor") -> None:
    """On the wall: every rule held, everything seen, and each robot replays from its recorded inbox."""
    finished = kantor("run", "office", "--exchange", "wall", "--speed", 10, *SMALL)
    assert finished.code == 0, finished.out + finished.err

    (folder,) = kantor.runs()
    result = result_of(folder)
    assert (result["ended"], result["violations"]) == ("done", 0)
    assert result["map"]["explored"] == 1.0
    assert (folder / "report.png").stat().st_size > 20_000
    assert "replayed" in kantor("verify", folder).out


def test_the_others_explore_what_a_killed_robot_leaves(kantor: "Kantor") -> None:
    """SIGKILL to r2 in the middle: what it headed for is explored by those who are left."""
    process = kantor.start("run", "office", "--exchange", "wall", "--speed", 6, *SMALL)
    await_line(process, "t=", "explored")
    (folder,) = kantor.runs()
    os.kill(children_named(process, folder / "logs" / "r2.log"), signal.SIGKILL)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    result = result_of(folder)
    assert process.returncode == 3, out + err
    assert (result["ended"], result["violations"]) == ("done", 0), out
    assert result["map"]["explored"] > 0.999
