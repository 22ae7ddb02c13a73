"""How commands and their processes end: starts that fail, signals at any moment, crashes, and what is left then."""

import json
import os
import resource
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest

from kantor_fleet.exits import Exit
from kantor_fleet.processes import local, mission
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_worldsim.record.journal import read
from support.files import wait_until
from support.processes.fleets import await_line, await_text, children_named, result_of
from support.processes.workers import crash

if TYPE_CHECKING:
    from support.processes.command import Kantor, Process

FLEET = ("run", "fleet", "--set", "limit_s=100000", "energy.points=50000", "energy.steps=50000")


@pytest.fixture
def temporary(kantor: "Kantor") -> Iterator[Path]:
    """A temporary folder of the commands' own, by which everything of theirs is found."""
    with tempfile.TemporaryDirectory() as folder:  # the path of a socket must be short
        yield Path(folder)
        kantor.stop_all()
        for process in started_with(Path(folder)):
            process.kill()


def started_with(temporary: Path) -> list[psutil.Process]:
    """Every process of a command with this temporary folder, and of whatever it started."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("TMPDIR") == str(temporary):
                found.append(process)
        except (psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess):
            continue
    return found


def started(kantor: "Kantor", temporary: Path, *words: object) -> "Process":
    """A command with a temporary folder of its own."""
    return kantor.start(*words, TMPDIR=str(temporary))


def assert_nothing_left(temporary: Path) -> None:
    """No process, and no file or socket in the temporary folder."""
    wait_until(lambda: not started_with(temporary))
    assert list(temporary.iterdir()) == []


def await_run(kantor: "Kantor", process: "Process", moment: str) -> None:
    """Return at a moment of the start of a run."""
    await_line(process, "starting the fleet")
    if moment == "a folder":
        wait_until(lambda: bool(kantor.runs()))
    elif moment == "a log":
        wait_until(lambda: bool([*kantor.folder.glob("runs/*/logs/r1.log")]))
    elif moment == "a mission":
        await_line(process, "t=", "energy")


MOMENTS = ("nothing", "a folder", "a log", "a mission")


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_command_that_is_killed_leaves_nothing_running(
    kantor: "Kantor", temporary: Path, moment: str
) -> None:
    """SIGKILL to `kantor run` alone: every process ends, even a stopped one; no secret, no socket, no empty folder."""
    process = started(kantor, temporary, *FLEET)
    await_run(kantor, process, moment)
    if moment == "a mission":
        log = kantor.runs()[0] / "logs" / "r1.log"
        os.kill(children_named(process, log), signal.SIGSTOP)
    process.kill()
    process.wait()

    assert_nothing_left(temporary)
    for folder in kantor.runs():
        assert next(read(folder / "run.mcap"), None) is not None
    if moment == "a mission":
        assert kantor("verify", kantor.runs()[0]).code == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_signal_ends_a_run_at_any_moment(
    kantor: "Kantor", temporary: Path, moment: str, number: signal.Signals
) -> None:
    """To the whole group, as a terminal or a service manager sends it: the right code, and no empty folder."""
    process = started(kantor, temporary, *FLEET)
    await_run(kantor, process, moment)
    os.killpg(process.pid, number)
    _, err = process.communicate()

    assert (process.returncode, err) == (128 + number, "")
    assert_nothing_left(temporary)
    for folder in kantor.runs():
        # It is deserted if no robot was there yet.
        early = {"deserted"} if moment != "a mission" else set()
        assert result_of(folder)["ended"] in {"interrupted"} | early
        assert kantor("verify", folder).code == 0
    if moment == "a mission":
        assert len(kantor.runs()) == 1


@pytest.mark.parametrize("exchange", ["lockstep", "realtime"])
def test_a_mission_that_is_interrupted_while_it_waits_was_not_deserted(
    kantor: "Kantor", exchange: str
) -> None:
    """Whoever was not there yet has not left."""
    world = kantor.start(
        "worldsim", "paper-single", "--listen", free_endpoint(), "--exchange", exchange
    )
    await_line(world, "t=", "waiting")
    world.send_signal(signal.SIGINT)
    world.communicate()

    assert world.returncode == 130
    assert result_of(kantor.runs()[0])["ended"] == "interrupted"


def test_no_password_of_a_local_fleet_is_on_a_disk(kantor: "Kantor", temporary: Path) -> None:
    """While it runs, there is nothing in the temporary folder but the fork server's socket."""
    process = started(kantor, temporary, *FLEET)
    await_line(process, "t=", "energy")

    files = [path for path in temporary.rglob("*") if not path.is_dir()]
    assert [path.is_socket() for path in files] == [True]


def test_a_start_without_descriptors_leaves_nothing(kantor: "Kantor", temporary: Path) -> None:
    """Too few for all robots: one line with the remedy, exit code 3, no process and no folder."""
    process = started(
        kantor, temporary, "run", "fleet",
        "--set", "robots.count=12", "starts.random=true", "energy.points=400", "energy.steps=5",
    )  # fmt: skip
    await_line(process, "starting the fleet")
    resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (36, 36))
    _, err = process.communicate()

    (line,) = err.splitlines()
    assert process.returncode == 3
    assert line.startswith("kantor: r")
    assert "cannot be started (Too many open files); see the limits" in line
    assert_nothing_left(temporary)
    assert kantor.runs() == []


def test_a_crash_of_world_sim_is_a_failed_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An exception in it: one line that names its log, and exit code 3."""
    monkeypatch.setattr(local, "_be_world_sim", crash)
    monkeypatch.setattr(local, "_START_S", 1.0)
    scenario = find("fleet", ("limit_s=5", "robots.count=1", "starts.random=true"), None)
    code = mission.run(scenario, 0, "lockstep", 1.0, tmp_path, None)

    (line,) = capsys.readouterr().err.splitlines()
    (folder,) = tmp_path.iterdir()
    assert code == Exit.PROCESS_FAILED
    assert line == f"kantor: world-sim ended with exit code 1; see {folder}/logs/worldsim.log"
    assert "RuntimeError: a crash" in (folder / "logs" / "worldsim.log").read_text()


def world_sim(kantor: "Kantor", *words: object) -> tuple["Process", str]:
    """A world-sim of one robot, and its endpoint."""
    endpoint = free_endpoint()
    process = kantor.start("worldsim", *words, "--listen", endpoint)
    return process, endpoint


ONE_ROBOT = ("paper-single", "--exchange", "lockstep")


def test_a_run_that_goes_on_cannot_be_resumed(kantor: "Kantor") -> None:
    """One line and exit code 2 for the second world-sim; the record of the first is whole."""
    world, endpoint = world_sim(kantor, *ONE_ROBOT)
    await_line(world, "t=")
    (folder,) = kantor.runs()
    second = kantor("worldsim", "--resume", folder, "--listen", free_endpoint())
    robot = kantor.start("agent", "r1", "--connect", endpoint)
    await_line(world, "t=", "energy")
    third = kantor("worldsim", "--resume", folder, "--listen", free_endpoint())
    world.send_signal(signal.SIGINT)
    world.communicate()

    for refused in (second, third):
        assert (refused.code, refused.out) == (2, "")
        assert refused.err == (
            f"kantor: {folder}: another process runs this mission; wait for its end, or end it\n"
        )
    assert robot.wait() == 0
    assert result_of(folder)["ended"] == "interrupted"
    assert kantor("verify", folder).code == 0


def test_of_two_that_resume_a_run_one_does(kantor: "Kantor") -> None:
    """After a SIGKILL, both at once: one goes on to the end, the other is refused in one line."""
    world, endpoint = world_sim(kantor, *ONE_ROBOT)
    robot = kantor.start("agent", "r1", "--connect", endpoint)
    await_line(world, "t=", "energy")
    (folder,) = kantor.runs()
    world.kill()
    world.wait()
    both = [kantor.start("worldsim", "--resume", folder, "--listen", endpoint) for _ in range(2)]
    wait_until(lambda: any(process.poll() is not None for process in both))
    (refused,) = (process for process in both if process.poll() is not None)
    (resumed,) = (process for process in both if process is not refused)
    out, err = refused.communicate()
    await_line(resumed, "t=", "energy")
    resumed.send_signal(signal.SIGINT)
    resumed.communicate()

    assert (refused.returncode, out, len(err.splitlines())) == (2, "", 1)
    assert (resumed.returncode, robot.wait()) == (130, 0)
    assert kantor("verify", folder).code == 0


def test_a_run_of_a_local_fleet_has_an_owner(kantor: "Kantor", temporary: Path) -> None:
    """From its start, and also while its world-sim is down and is started again."""
    process = started(kantor, temporary, *FLEET)
    await_line(process, "t=", "energy")
    (folder,) = kantor.runs()
    log = folder / "logs" / "worldsim.log"
    for times in (1, 2):
        os.kill(children_named(process, log) if times == 1 else _last_pid(log), signal.SIGKILL)
        refused = kantor("worldsim", "--resume", folder, "--listen", free_endpoint())
        assert (refused.code, len(refused.err.splitlines())) == (2, 1)
        await_text(log, "resumed", times)
    process.send_signal(signal.SIGINT)
    process.communicate()

    assert kantor("verify", folder).code == 0


def _last_pid(log: Path) -> int:
    return int(json.loads(log.read_text().splitlines()[-1])["pid"])
