"""`kantor chaos docker`: apply a file of [[faults]] to containers, and check the record afterwards.

World-sim does not know this schedule: its record has only what it noticed, that participants left and came back.
"""

import json
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from kantor_fleet.execution.verify import Finding, findings, print_findings
from kantor_fleet.exits import Exit, fail
from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import Partition
from kantor_protocol.scenario.faults.processes import Kill, Pause
from kantor_protocol.scenario.faults.schedule import kind_of
from kantor_protocol.scenario.load import load, with_chaos
from kantor_worldsim.record.journal import read
from kantor_worldsim.record.records import Ending, ProcessEvent
from kantor_worldsim.record.run_folder import JOURNAL, MANIFEST, SCENARIO

_POLL_S = 0.2
_LEAVE_NOTICED_S = 2.0
"""Real time within which world-sim notices that a participant is gone: a lease and some slack."""
_TIME = re.compile(r"t= *([0-9.]+) s  explored", re.MULTILINE)
_COMMANDS = {"kill": ("kill", "start"), "pause": ("pause", "unpause"), "partition": ("cut", "join")}


class ContainersError(RuntimeError):
    """Containers that do not exist, or a command to the engine that failed; the message is one line."""


class ContainerCommand(NamedTuple):
    """A command to a container, at a time of the mission in seconds."""

    at_s: float
    undoes: bool
    """It ends the effect of an earlier command; of two at the same moment it comes first."""
    action: str
    """kill, start, pause, unpause, cut or join."""
    who: ParticipantId
    fault: int


def chaos_docker(storm: Path, project: str, start_timeout_s: float) -> Exit:
    """Apply the faults of a file to the containers of a compose project; NOT_MET if a finding is a failure.

    start_timeout_s: real time to wait for the mission to begin. Raises ScenarioError.
    """
    try:
        fleet = Containers(project)
        clock = MissionClock(fleet)
        run = clock.await_mission(start_timeout_s)
        scenario = with_chaos(load(run / SCENARIO), storm)
        earlier = len(load(run / SCENARIO).faults)
        commands = commands_of(scenario.faults[earlier:])
        done = _carry_out(commands, fleet, clock)
        code = fleet.wait()
    except ContainersError as error:
        fail(Exit.USAGE, str(error))
    found = [
        *_findings_on_commands(run, commands, done, clock.speed),
        (code == 0, f"world-sim ended with exit code {code}"),
        *findings(run),
    ]
    return print_findings(found)


def commands_of(faults: tuple[Fault, ...]) -> list[ContainerCommand]:
    """The commands of faults, in order; ends the process for a fault that cannot be applied to containers."""
    commands = []
    for i, fault in enumerate(faults):
        action, undo = _COMMANDS.get(kind_of(fault), ("", ""))
        plain = isinstance(fault, Pause) or (
            isinstance(fault, Kill) and fault.disk == "kept" and not fault.mid_step
        )
        if isinstance(fault, Partition) and fault.shape == "isolate" and fault.flap_s is None:
            targets, plain = fault.robots, True
        elif isinstance(fault, (Kill, Pause)):
            targets = fault.who
        if not plain:
            fail(
                Exit.USAGE,
                f"faults[{i}]: a {kind_of(fault)} like this is not for containers: kill (disk kept), pause, and "
                f'partition with shape "isolate" are; faults of links go to --chaos of `kantor worldsim`',
            )
        for name in targets:
            commands.append(
                ContainerCommand(fault.from_s, undoes=False, action=action, who=name, fault=i)
            )
            if fault.until_s is not None:
                commands.append(
                    ContainerCommand(fault.until_s, undoes=True, action=undo, who=name, fault=i)
                )
    return sorted(commands, key=lambda c: (c.at_s, not c.undoes, c.fault, c.who))


def _carry_out(
    commands: list[ContainerCommand], fleet: "Containers", clock: "MissionClock"
) -> dict[ContainerCommand, float]:
    """Carry out commands when they are due, until the mission is over; the mission's time of each, in seconds."""
    done: dict[ContainerCommand, float] = {}
    for command in commands:
        while (now_s := clock.now_s()) < command.at_s:
            if not fleet.runs(WORLD_SIM) and not clock.world_is_down:
                return done
            time.sleep(_POLL_S)
        if command.who == WORLD_SIM:
            clock.world_is_down = not command.undoes
        elif not command.undoes and not fleet.runs(WORLD_SIM):
            return done
        fleet.carry_out(command)
        done[command] = now_s
        print(f"t={now_s:6.1f} s  {command.who}: {command.action}", flush=True)
    return done


def _findings_on_commands(
    run: Path, commands: list[ContainerCommand], done: dict[ContainerCommand, float], speed: float
) -> Iterator[Finding]:
    """Whether each command was carried out, and world-sim recorded its effect."""
    records = [record for _, record in read(run / JOURNAL)]
    events = [record for record in records if isinstance(record, ProcessEvent)]
    ending_s = next((r.now_ns * 1e-9 for r in records if isinstance(r, Ending)), None)
    for command in commands:
        line = f"{command.who}: {command.action} at t={command.at_s:g} s"
        if command not in done:
            yield False, f"{line}: the mission was over before"
            continue
        awaited = "join" if command.undoes else "leave"
        from_s = done[command] - 1.0 * speed  # the log has the time once a second
        seen = next(
            (
                event.now_ns * 1e-9
                for event in events
                if (event.who, event.kind) == (command.who, awaited)
                and event.now_ns * 1e-9 >= from_s
            ),
            None,
        )
        frozen_world = command.who == WORLD_SIM and command.action in {"pause", "unpause"}
        late = ending_s is not None and ending_s - done[command] < _LEAVE_NOTICED_S * speed
        if seen is not None:
            yield True, f"{line}: on record, {awaited} at t={seen:.1f} s"
        else:
            excuse = (
                "which world-sim cannot notice" if frozen_world else "the mission ended at once"
            )
            yield (
                frozen_world or late,
                f"{line}: not on record" + (f", {excuse}" if frozen_world or late else ""),
            )


class MissionClock:
    """The mission's time, which world-sim logs once a second."""

    def __init__(
        self, fleet: "Containers", monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self.speed = 1.0
        self.world_is_down = False
        """A command has killed or paused world-sim; time goes on."""
        self._fleet = fleet
        self._monotonic = monotonic
        self._logged_s = -1.0
        self._logged_at_s = 0.0

    def await_mission(self, timeout_s: float) -> Path:
        """The folder of the run, once the mission has begun. Raises ContainersError."""
        give_up = self._monotonic() + timeout_s
        while self.now_s() < 0.0:
            if self._monotonic() > give_up:
                raise ContainersError(
                    f"no mission has begun after {timeout_s:g} s; see `docker-compose logs worldsim`"
                )
            time.sleep(_POLL_S)
        runs = sorted(path.parent for path in self._fleet.runs_folder.glob(f"*/{MANIFEST}"))
        if not runs:
            raise ContainersError(f"{self._fleet.runs_folder}: no run in it")
        self.speed = float(json.loads((runs[-1] / MANIFEST).read_text(encoding="utf-8"))["speed"])
        return runs[-1]

    def now_s(self) -> float:
        """Simulated seconds, or below 0 before the mission."""
        times = _TIME.findall(self._fleet.log_end(WORLD_SIM))
        if times and float(times[-1]) != self._logged_s:
            self._logged_s, self._logged_at_s = float(times[-1]), self._monotonic()
        if self._logged_s < 0.0:
            return -1.0
        return self._logged_s + (self._monotonic() - self._logged_at_s) * self.speed


class Containers:
    """The containers of a compose project, by the names of their services."""

    def __init__(self, project: str) -> None:
        """Raises ContainersError if world-sim is not among them."""
        label = f"label=com.docker.compose.project={project}"
        ids = docker("ps", "--all", "--quiet", "--filter", label).split()
        found: list[dict[str, Any]] = json.loads(docker("inspect", *ids)) if ids else []
        self._ids: dict[ParticipantId, str] = {
            c["Config"]["Labels"]["com.docker.compose.service"]: c["Id"] for c in found
        }
        self._cut: dict[ParticipantId, list[str]] = {}
        world = next((c for c in found if c["Id"] == self._ids.get(WORLD_SIM)), None)
        if world is None:
            raise ContainersError(
                f"--project {project}: no container of world-sim; start the fleet first"
            )
        self.runs_folder = next(
            Path(m["Source"]) for m in world["Mounts"] if m["Destination"] == "/runs"
        )

    def _id(self, name: ParticipantId) -> str:
        if name not in self._ids:
            raise ContainersError(f"{name}: no such container in the project")
        return self._ids[name]

    def runs(self, name: ParticipantId) -> bool:
        """Whether it runs, or the engine is about to start it again."""
        state = docker(
            "inspect", "--format", "{{.State.Running}} {{.State.Restarting}}", self._id(name)
        )
        return "true" in state

    def log_end(self, name: ParticipantId) -> str:
        """The last lines of its log."""
        return docker("logs", "--tail", "3", self._id(name))

    def wait(self) -> int:
        """Exit code of world-sim, once it has ended."""
        return int(docker("wait", self._id(WORLD_SIM)))

    def carry_out(self, command: ContainerCommand) -> None:
        """Carry out a command."""
        container = self._id(command.who)
        if command.action == "cut":
            form = "{{range $name, $_ := .NetworkSettings.Networks}}{{$name}} {{end}}"
            self._cut[command.who] = docker("inspect", "--format", form, container).split()
            for network in self._cut[command.who]:
                docker("network", "disconnect", network, container)
        elif command.action == "join":
            for network in self._cut.pop(command.who, []):
                docker("network", "connect", "--alias", command.who, network, container)
        else:
            docker(command.action, container)


def docker(*arguments: str) -> str:
    """Output of a docker command. Raises ContainersError."""
    try:
        done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise ContainersError("docker: not installed") from None
    if done.returncode:
        problem = (done.stderr.strip() or "failed").splitlines()[-1]
        raise ContainersError(f"docker {' '.join(arguments[:2])}: {problem}")
    return str(done.stdout)
