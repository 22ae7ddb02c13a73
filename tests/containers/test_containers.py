"""Fleets in containers: to the end, through storms, apart from one another, and within their limits."""

import json
import os
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from containers.engine import BASE, IMAGE, Fleet, call, resident_mb
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.execution.verify import findings
from kantor_fleet.processes.compose import ComposeConfig
from kantor_fleet.scenarios.catalog import find
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import incidents_of, result_of

if TYPE_CHECKING:
    from support.processes.command import Kantor

pytestmark = pytest.mark.xdist_group("containers")

MakeFleet = Callable[..., Fleet]
FIVE = ComposeConfig(5, supervisor=True)
NEAR = "radio.range_m=300 energy.points=2500"
TINY = "starts.random=true samples.count=400 targets.count=60 energy.points=800 radio.range_m=500"


def rate_in_process(*overrides: str) -> float:
    """Detection of the same mission in one process."""
    scenario = find("fleet", overrides)
    recording = Recording(scenario, 0, "in-process")
    play(scenario, 0, WorldSetup.of(scenario, 0), [recording.observe])
    rate = recording.finish().detection_rate
    assert rate is not None
    return rate


def check_record(fleet: Fleet) -> dict[str, object]:
    """The run folder on the host is whole, keeps the rules, and can be executed again."""
    folder = fleet.run_folder()
    assert [line for held, line in findings(folder) if not held] == []
    assert (folder / "report.png").exists()
    result = result_of(folder)
    assert result["ended"] == "done"
    assert result["violations"] == 0
    return result


def test_five_robots_explore_to_the_end(fleet_of: MakeFleet) -> None:
    """One command; exit code 0; as good as elsewhere; small, healthy, no process is root."""
    fleet = fleet_of(FIVE, speed="8")
    up = fleet.start("up", "--exit-code-from", "worldsim")
    fleet.await_log("worldsim", r"explored [5-9]\d %")
    resident = {}
    for name in ("r1", "r2", "r3", "r4", "r5"):
        state = fleet.inspect(name)["State"]
        resident[name] = resident_mb(state["Pid"])
        assert state["Health"]["Status"] == "healthy"
        assert fleet.inspect(name)["HostConfig"]["ReadonlyRootfs"]
        owner = Path(f"/proc/{state['Pid']}").stat().st_uid
        assert owner != 0
    out, _ = up.communicate(timeout=EVENT_LIMIT_S)

    assert up.returncode == 0, out[-2000:]
    result = check_record(fleet)
    assert abs(float(str(result["detection_rate"])) - rate_in_process()) <= 0.05
    assert max(resident.values()) <= 120.0, resident


def test_a_supervisor_comes_with_its_profile(fleet_of: MakeFleet) -> None:
    """The same file, centralized."""
    fleet = fleet_of(FIVE, speed="8", set="coordination=centralized")
    up = fleet.start("--profile", "centralized", "up", "--exit-code-from", "worldsim")
    out, _ = up.communicate(timeout=EVENT_LIMIT_S)

    assert up.returncode == 0, out[-2000:]
    rate = float(str(check_record(fleet)["detection_rate"]))
    assert abs(rate - rate_in_process("coordination=centralized")) <= 0.05


STORM = """
[[faults]]
kind = "partition"   # off its network for 20 s of real time, at speed 2
shape = "isolate"
robots = ["r4"]
from_s = 6
until_s = 46
[[faults]]
kind = "pause"
who = ["r2"]
from_s = 8
until_s = 44
[[faults]]
kind = "kill"
who = ["r3"]
from_s = 12
until_s = 44
"""


def test_a_storm_over_containers(fleet_of: MakeFleet, kantor: "Kantor") -> None:
    """Cut off for 20 s, paused, killed and started: the mission is completed, the record shows it all."""
    fleet = fleet_of(FIVE, speed="2", set=NEAR)
    fleet.compose("up", "--detach")
    (kantor.folder / "storm.toml").write_text(STORM)
    chaos = kantor.start("chaos", "docker", "storm.toml", "--project", fleet.project)
    out, err = chaos.communicate(timeout=EVENT_LIMIT_S)

    assert chaos.returncode == 0, out + err
    assert len(re.findall(r"^ok .*on record, (?:leave|join)", out, re.MULTILINE)) == 6
    assert "FAIL" not in out
    result = result_of(fleet.run_folder())  # chaos has verified the rest
    assert (result["ended"], result["violations"]) == ("done", 0)
    assert float(str(result["detection_rate"])) >= 0.8
    seen = {(incident.who, incident.kind) for incident in incidents_of(fleet.run_folder())}
    assert seen >= {(who, what) for who in ("r2", "r3", "r4") for what in ("leave", "join")}
    assert fleet.inspect("worldsim")["State"]["ExitCode"] == 0


def test_a_killed_world_sim_is_started_again_and_goes_on(fleet_of: MakeFleet) -> None:
    """The engine starts it again; robots hold meanwhile; a robot that is killed comes back as well."""
    fleet = fleet_of(FIVE, speed="4", set=NEAR)
    fleet.compose("up", "--detach")
    fleet.await_log("worldsim", r"explored [2-9]\d %")
    call("docker", "kill", fleet.id("r1"))
    call("docker", "start", fleet.id("r1"))
    fleet.await_log("r1", "goes on as incarnation 0")
    assert fleet.readiness_s("r1") > 0.0  # it is on the bus since it was started again
    if os.getuid() == 0:
        os.kill(fleet.inspect("worldsim")["State"]["Pid"], signal.SIGKILL)
    else:  # only root reaches into a container; what the engine is told to kill it leaves so
        call("docker", "kill", fleet.id("worldsim"))
        call("docker", "start", fleet.id("worldsim"))
    fleet.await_log("worldsim", "over: done")
    fleet.await_state("worldsim", "exited")

    assert fleet.inspect("worldsim")["State"]["ExitCode"] == 0
    check_record(fleet)
    assert json.loads((fleet.run_folder() / "manifest.json").read_text())["resumed"] == 1
    of_world = [i.kind for i in incidents_of(fleet.run_folder()) if i.who == "worldsim"]
    assert of_world == ["leave", "join"]


LISTEN = "import socket; s = socket.create_server(('0.0.0.0', 9999)); print('listens', flush=True)\nwhile True: s.accept()"
CONNECT = "import socket, sys; socket.create_connection((sys.argv[1], 9999), timeout=2.0)"


def test_isolated_robots_cannot_reach_each_other(fleet_of: MakeFleet) -> None:
    """Not by name, not by address; world-sim reaches both, and the mission is completed."""
    fleet = fleet_of(ComposeConfig(2, isolated=True), speed="4", set=TINY)
    fleet.compose("up", "--detach")
    fleet.await_log("worldsim", "explored")
    networks = fleet.inspect("r2")["NetworkSettings"]["Networks"]
    (address,) = (network["IPAddress"] for network in networks.values())
    listener = subprocess.Popen(
        ["docker", "exec", fleet.id("r2"), "python3", "-c", LISTEN],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert listener.stdout is not None
    assert listener.stdout.readline() == "listens\n"

    def reaches(service: str, place: str) -> bool:
        command = ["docker", "exec", fleet.id(service), "python3", "-c", CONNECT, place]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    assert reaches("worldsim", address)
    assert not reaches("r1", address)
    assert not reaches("r1", "r2")
    fleet.await_state("worldsim", "exited")
    listener.communicate(timeout=EVENT_LIMIT_S)
    assert fleet.inspect("worldsim")["State"]["ExitCode"] == 0
    check_record(fleet)


WARM = """
import gc
from kantor_fleet.execution.preload import warm_up
warm_up()
from kantor_protocol.base.kernels import Kernel
kernels = [each for each in gc.get_objects() if isinstance(each, Kernel)]
print(sum(sum(k.stats.cache_hits.values()) for k in kernels), sum(sum(k.stats.cache_misses.values()) for k in kernels))
"""


def test_nothing_is_compiled_in_a_container(image: str) -> None:
    """Every kernel comes from the image, for any user and with a read-only root."""
    safe = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL", "--user", "4242:4242")
    told = call("docker", "run", "--rm", *safe, "--entrypoint", "python3", image, "-c", WARM)
    hits, misses = map(int, told.split())

    assert hits > 20
    assert misses == 0


@pytest.mark.usefixtures("image")
def test_the_image_is_small() -> None:
    """At most 450 MB over its base."""
    sizes = [
        int(call("docker", "image", "inspect", "--format", "{{.Size}}", name))
        for name in (IMAGE, BASE)
    ]

    assert sizes[0] - sizes[1] <= 450e6
