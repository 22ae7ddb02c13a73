"""Real processes on the real bus: the three exchanges, and what happens to a fleet."""

import os
import signal
import statistics
from typing import TYPE_CHECKING

import psutil
import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.world.world import WorldSetup
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import (
    acts_of,
    await_act,
    await_line,
    children_named,
    records_of,
    result_of,
)

if TYPE_CHECKING:
    from support.processes.command import Kantor

LOSSY = (
    "--set", "radio.drop=0.1", "radio.duplicate=0.1", "radio.delay_s=0.03", "radio.jitter_s=0.2",
    "radio.reorder=0.1", "merge='ledger'", "claims=true",
)  # fmt: skip


def detection(scenario: Scenario, seed: int) -> float:
    """The detection rate in virtual time."""
    setup, metrics = WorldSetup.of(scenario, seed), DensityMetrics()
    play(scenario, seed, setup, [Pipeline(metrics).observe])
    return len(metrics.finds) / len(setup.targets_m)


def test_same_seed_same_digest_in_process_and_over_the_bus(kantor: "Kantor") -> None:
    """Five robots and the supervisor, the full run, 10 % drops, 10 % duplicates and delays; twice each
    way, under different hash seeds; verify confirms every one.
    """
    for exchange in ("in-process", "lockstep"):
        for hash_seed in ("0", "123"):
            finished = kantor(
                "run", "paper-centralized-concurrent", "--seed", 5, "--exchange", exchange, *LOSSY,
                PYTHONHASHSEED=hash_seed,
            )  # fmt: skip
            assert finished.code == 0, finished.err

    runs = kantor.runs()
    results = [result_of(folder) for folder in runs]
    assert len(runs) == 4
    assert len({result["digest"] for result in results}) == 1
    assert [result["exchange"] for result in results].count("lockstep") == 2
    assert all(result["drops"] > 500 for result in results)
    finished = kantor("verify", runs[-1])
    assert finished.code == 0
    assert "every byte the same" in finished.out


def test_registers_are_the_same_in_process_and_over_the_bus(kantor: "Kantor") -> None:
    """Multiscale coverage with loss, repetition and delay: integers add up to the same everywhere."""
    for exchange in ("in-process", "lockstep"):
        finished = kantor(
            "run", "fleet", "--exchange", exchange, *LOSSY, "planner=spectral", "energy.points=1000",
        )  # fmt: skip
        assert finished.code == 0, finished.err

    results = [result_of(folder) for folder in kantor.runs()]
    assert len({result["digest"] for result in results}) == 1
    assert [result["planner"] for result in results] == ["spectral", "spectral"]
    assert all(result["claims"] is False for result in results)
    assert "every byte the same" in kantor("verify", kantor.runs()[-1]).out


def test_a_realtime_run_finds_what_virtual_time_finds(kantor: "Kantor") -> None:
    """Robots with different periods, drift and jitter, each on its own timer: detection within five
    points of virtual time (median of seven seeds), every rule held, and each robot replays from its
    recorded inbox.
    """
    # With a budget of energy both end after the same number of steps, whichever robots met. A process that waits
    # for a core is late by `speed` times as long for the others: so it is low, and no limit cuts a slow machine short.
    name = "paper-centralized-concurrent"
    clocks = ("clock.spread=0.1", "clock.drift_ppm=1000", "clock.jitter_s=0.01")
    overrides = ("merge='ledger'", "claims=true", "limit_s=100000", *clocks)
    virtual = statistics.median(detection(find(name, overrides), seed) for seed in range(7))
    wall = kantor("run", name, "--exchange", "wall", "--speed", 4, "--set", *overrides)
    assert wall.code == 0, wall.out + wall.err

    (folder,) = kantor.runs()
    assert abs(virtual - result_of(folder)["detection_rate"]) <= 0.05
    finished = kantor("verify", folder)
    assert finished.code == 0, finished.out
    assert "replayed" in finished.out


@pytest.mark.parametrize("exchange", ["lockstep", "wall"])
def test_a_killed_robot_does_not_stop_the_others(kantor: "Kantor", exchange: str) -> None:
    """SIGKILL to r3 in the middle: the others finish, the record says who was missing, exit code 3."""
    process = kantor.start(
        "run", "fleet", "--exchange", exchange, "--speed", 16, "--set", "limit_s=100000"
    )
    await_line(process, "t=", "energy")
    (folder,) = kantor.runs()
    os.kill(children_named(process, folder / "logs" / "r3.log"), signal.SIGKILL)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    result = result_of(folder)
    assert process.returncode == 3, out + err
    assert "r3 ended with signal 9; the others go on" in out
    assert (result["ended"], result["violations"]) == ("done", 0)
    assert result["mass_left"] < 0.05
    assert kantor("verify", folder).code == 0


def test_ctrl_c_ends_every_process_and_leaves_a_valid_record(kantor: "Kantor") -> None:
    """SIGINT to the whole group, as a terminal sends it."""
    process = kantor.start("run", "fleet", "--exchange", "wall", "--speed", 2)
    await_line(process, "t=", "energy")
    family = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    (folder,) = kantor.runs()
    assert process.returncode == 130, out + err
    assert len(family) >= 6
    assert psutil.wait_procs(family, timeout=EVENT_LIMIT_S)[1] == []
    assert result_of(folder)["ended"] == "interrupted"
    assert (folder / "report.png").exists()
    assert kantor("verify", folder).code == 0


def test_standalone_robots_start_in_any_order(kantor: "Kantor") -> None:
    """r2 before world-sim, the supervisor and r1 after it; each needs an endpoint, an id and
    credentials, and gets the mission from world-sim.
    """
    endpoint = free_endpoint()
    connect = ("--connect", endpoint)
    early = kantor.start("agent", "r2", *connect)
    world = kantor.start(
        "worldsim", "paper-timevarying", "--listen", endpoint, "--exchange", "lockstep",
        "--set", "limit_s=20", "energy.points=200",
    )  # fmt: skip
    await_line(world, "t=")
    others = [kantor.start("supervisor", *connect), kantor.start("agent", "r1", *connect)]

    out, err = world.communicate(timeout=EVENT_LIMIT_S)
    assert world.returncode == 0, out + err
    for participant in (early, *others):
        told, complaint = participant.communicate(timeout=EVENT_LIMIT_S)
        assert participant.returncode == 0, complaint
        assert told.splitlines()[-1].endswith("mission over: done")
    assert result_of(kantor.runs()[0])["energy_spent"] == 200


def test_a_robot_may_come_late(kantor: "Kantor") -> None:
    """World-sim starts without r5 when its patience ends; r5 joins in and works."""
    endpoint = free_endpoint()
    world = kantor.start(
        "worldsim", "fleet", "--listen", endpoint, "--speed", 5, "--start-after", 3,
        "--set", "limit_s=100000", "energy.points=50000", "energy.steps=50000",
    )  # fmt: skip
    await_line(world, "t=")
    robots = [kantor.start("agent", f"r{i}", "--connect", endpoint) for i in range(1, 5)]
    while float(await_line(world, "t=", "energy").split()[1]) < 2.0:  # seconds of the mission
        pass
    robots.append(kantor.start("agent", "r5", "--connect", endpoint))
    (folder,) = kantor.runs()
    await_act(folder, "r5")
    world.send_signal(signal.SIGINT)
    out, err = world.communicate(timeout=EVENT_LIMIT_S)

    for robot in robots:
        assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    assert "all rules held" in out, out + err
    records = records_of(folder)
    first = {name: acts_of(records, name)[0].now_ns for name in ("r1", "r5")}
    assert first["r5"] > first["r1"] + 1_000_000_000


def test_ids_and_credentials_are_checked(kantor: "Kantor") -> None:
    """A doubled id, an unknown id, another's credentials, wrong credentials: one line each."""
    endpoint = free_endpoint()
    world = kantor.start("worldsim", "paper-single", "--listen", endpoint, "--start-after", "60")
    await_line(world, "t=")
    connect = ("--connect", endpoint)
    robot = kantor.start("agent", "r1", *connect)
    await_line(robot, "r1: mission paper-single")
    stolen = kantor.folder / "stolen.toml"
    text = (kantor.folder / "credentials" / "r1.toml").read_text()
    stolen.write_text(text.replace("password = ", 'password = "x" #'))

    doubled = kantor("agent", "r1", *connect)
    unknown = kantor("agent", "r9", *connect)
    others = kantor("agent", "r2", *connect, "--credentials", "credentials/r1.toml")
    wrong = kantor("agent", "r1", *connect, "--credentials", stolen)

    assert (doubled.code, doubled.err) == (
        2,
        "kantor: r1: is on the bus already; stop the other process or choose another id\n",
    )
    assert unknown.code == 2
    assert "no credentials for r9; known here: observer, r1, worldsim" in unknown.err
    assert (others.code, others.err) == (
        2,
        "kantor: credentials/r1.toml: credentials of r1, not of r2\n",
    )
    assert wrong.code == 4
    assert "refuses r1; its credentials are not this world-sim's" in wrong.err
    assert (kantor.folder / "credentials" / "r1.toml").stat().st_mode & 0o077 == 0
    world.send_signal(signal.SIGINT)
    assert world.wait(timeout=EVENT_LIMIT_S) == 130


def test_tap_prints_the_bus_decoded(kantor: "Kantor") -> None:
    """Poses, weights and radio, as plain msgpack says."""
    endpoint = free_endpoint()
    world = kantor.start("worldsim", "paper-single", "--listen", endpoint, "--set", "limit_s=40")
    await_line(world, "t=")
    robot = kantor.start("agent", "r1", "--connect", endpoint)
    await_line(robot, "r1: mission")
    tapped = kantor("tap", "--connect", endpoint, "--only", "pose", "--count", 3)

    assert tapped.code == 0, tapped.err
    assert len(tapped.out.splitlines()) == 3
    assert all("r1" in line and "[21, 1, " in line for line in tapped.out.splitlines())
    world.send_signal(signal.SIGTERM)
    assert world.wait(timeout=EVENT_LIMIT_S) == 143
    assert robot.wait(timeout=EVENT_LIMIT_S) == 0


def test_a_second_world_sim_on_the_port_is_refused(kantor: "Kantor") -> None:
    """Exit code 4 and a line that says what to do; no run folder is left."""
    endpoint = free_endpoint()
    first = kantor.start("worldsim", "paper-single", "--listen", endpoint)
    await_line(first, "t=")
    second = kantor("worldsim", "paper-single", "--listen", endpoint, "--out", "second")

    assert second.code == 4
    assert f"cannot listen on {endpoint}" in second.err
    assert not (kantor.folder / "second").exists()
    first.send_signal(signal.SIGINT)
    assert first.wait(timeout=EVENT_LIMIT_S) == 130


def test_a_robot_process_imports_only_what_it_uses(kantor: "Kantor") -> None:
    """Its entry pulls in no plotting, no statistics, no world, no recorder."""
    import subprocess
    import sys

    script = (
        "import sys; from kantor_fleet.__main__ import main; "
        "import kantor_agent.process, kantor_fleet.processes.standalone; print('\\n'.join(sys.modules))"
    )
    modules = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    ).stdout.split()
    unwanted = ("matplotlib", "mcap", "kantor_worldsim", "PIL", "pytest", "msgpack", "cryptography")

    assert [module for module in modules if module.partition(".")[0] in unwanted] == []
    assert not {"scipy.stats", "scipy.spatial", "scipy.optimize", "scipy.linalg"} & set(modules)


def test_a_run_without_options_is_done(kantor: "Kantor") -> None:
    """Five processes in lockstep spend all their energy; `benchmarks/lockstep_speed.py` measures how fast."""
    assert kantor("run").code == 0
    result = result_of(kantor.runs()[0])
    assert (result["ended"], result["exchange"], result["robots"]) == ("done", "lockstep", 5)
