"""`kantor chaos docker`: what a file of [[faults]] orders is done to containers, and the record is checked afterwards.

World-sim knows nothing of it: what it has on record is what it saw, that somebody left and came back.
"""

import json
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from kantor_fleet.execution.verify import findings
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

_LOOK_S = 0.2
_NOTICED_S = 2.0
"""Real time after which a silent participant has left for world-sim: a lease, and a little."""
_TIME = re.compile(r"t= *([0-9.]+) s  explored", re.MULTILINE)
_COMMANDS = {"kill": ("kill", "start"), "pause": ("pause", "unpause"), "partition": ("cut", "join")}


class ContainersError(RuntimeError):
    """Containers that are not there or do not obey; the message is one line."""


class ContainerCommand(NamedTuple):
    """What is to be done to a container, and when, in seconds of the mission."""

    at_s: float
    ends: bool
    """Makes good what was done before; of two at the same moment it comes first."""
    what: str
    who: ParticipantId
    fault: int


def chaos_docker(storm: Path, project: str, patience_s: float) -> Exit:
    """Do to a compose project's containers what a file orders; NOT_MET if the record does not hold.

    Raises ScenarioError.
    """
    try:
        fleet = Containers(project)
        clock = MissionClock(fleet)
        run = clock.await_mission(patience_s)
        scenario = with_chaos(load(run / SCENARIO), storm)
        earlier = len(load(run / SCENARIO).faults)
        deeds = commands_of(scenario.faults[earlier:])
        done = _carry_out(deeds, fleet, clock)
        code = fleet.wait()
    except ContainersError as error:
        fail(Exit.USAGE, str(error))
    found = [
        *_judged(run, deeds, done, clock.speed),
        (code == 0, f"world-sim ended with exit code {code}"),
        *findings(run),
    ]
    for held, line in found:
        print(f"{'ok  ' if held else 'FAIL'}  {line}")
    return Exit.DONE if all(held for held, _ in found) else Exit.NOT_MET


def commands_of(faults: tuple[Fault, ...]) -> list[ContainerCommand]:
    """What is to be done, in order; fails for what cannot be done to containers."""
    deeds = []
    for i, fault in enumerate(faults):
        what, undo = _COMMANDS.get(kind_of(fault), ("", ""))
        plain = isinstance(fault, Pause) or (
            isinstance(fault, Kill) and fault.disk == "kept" and not fault.mid_step
        )
        if isinstance(fault, Partition) and fault.shape == "isolate" and fault.flap_s is None:
            people, plain = fault.robots, True
        elif isinstance(fault, (Kill, Pause)):
            people = fault.who
        if not plain:
            fail(
                Exit.USAGE,
                f"faults[{i}]: a {kind_of(fault)} like this is not for containers: kill (disk kept), pause, and "
                f'partition with shape "isolate" are; --chaos of `kantor worldsim` does what is on links',
            )
        for name in people:
            deeds.append(ContainerCommand(fault.from_s, ends=False, what=what, who=name, fault=i))
            if fault.until_s is not None:
                deeds.append(
                    ContainerCommand(fault.until_s, ends=True, what=undo, who=name, fault=i)
                )
    return sorted(deeds, key=lambda deed: (deed.at_s, not deed.ends, deed.fault, deed.who))


def _carry_out(
    deeds: list[ContainerCommand], fleet: "Containers", clock: "MissionClock"
) -> dict[ContainerCommand, float]:
    """Do what is due until everything is done or the mission is over; when each was done, in its seconds."""
    done: dict[ContainerCommand, float] = {}
    for deed in deeds:
        while (now_s := clock.now_s()) < deed.at_s:
            if not fleet.runs(WORLD_SIM) and not clock.world_is_down:
                return done
            time.sleep(_LOOK_S)
        if deed.who == WORLD_SIM:
            clock.world_is_down = not deed.ends
        elif not deed.ends and not fleet.runs(WORLD_SIM):
            return done
        fleet.do(deed)
        done[deed] = now_s
        print(f"t={now_s:6.1f} s  {deed.who}: {deed.what}", flush=True)
    return done


def _judged(
    run: Path, deeds: list[ContainerCommand], done: dict[ContainerCommand, float], speed: float
) -> Iterator[tuple[bool, str]]:
    """Whether each deed was done, and world-sim saw it."""
    records = [record for _, record in read(run / JOURNAL)]
    incidents = [record for record in records if isinstance(record, ProcessEvent)]
    ending_s = next((r.now_ns * 1e-9 for r in records if isinstance(r, Ending)), None)
    for deed in deeds:
        line = f"{deed.who}: {deed.what} at t={deed.at_s:g} s"
        if deed not in done:
            yield False, f"{line}: the mission was over before"
            continue
        awaited = "join" if deed.ends else "leave"
        from_s = done[deed] - 1.0 * speed  # the time is told once a second
        seen = next(
            (
                incident.now_ns * 1e-9
                for incident in incidents
                if (incident.who, incident.what) == (deed.who, awaited)
                and incident.now_ns * 1e-9 >= from_s
            ),
            None,
        )
        frozen_world = deed.who == WORLD_SIM and deed.what in {"pause", "unpause"}
        late = ending_s is not None and ending_s - done[deed] < _NOTICED_S * speed
        if seen is not None:
            yield True, f"{line}: on record, {awaited} at t={seen:.1f} s"
        else:
            excuse = "nobody sees that" if frozen_world else "the mission ended at once"
            yield (
                frozen_world or late,
                f"{line}: not on record" + (f", {excuse}" if frozen_world or late else ""),
            )


class MissionClock:
    """The mission's time, as world-sim's log tells it once a second."""

    def __init__(
        self, fleet: "Containers", monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self.speed = 1.0
        self.world_is_down = False
        """It is dead or frozen on order; time goes on."""
        self._fleet = fleet
        self._monotonic = monotonic
        self._told_s = -1.0
        self._told_at = 0.0

    def await_mission(self, patience_s: float) -> Path:
        """The folder of the run, once the mission has begun. Raises ContainersError."""
        give_up = self._monotonic() + patience_s
        while self.now_s() < 0.0:
            if self._monotonic() > give_up:
                raise ContainersError(
                    f"no mission has begun after {patience_s:g} s; see `docker-compose logs worldsim`"
                )
            time.sleep(_LOOK_S)
        runs = sorted(path.parent for path in self._fleet.runs_folder.glob(f"*/{MANIFEST}"))
        if not runs:
            raise ContainersError(f"{self._fleet.runs_folder}: no run in it")
        self.speed = float(json.loads((runs[-1] / MANIFEST).read_text(encoding="utf-8"))["speed"])
        return runs[-1]

    def now_s(self) -> float:
        """Simulated seconds, or below 0 before the mission."""
        told = _TIME.findall(self._fleet.last_words(WORLD_SIM))
        if told and float(told[-1]) != self._told_s:
            self._told_s, self._told_at = float(told[-1]), self._monotonic()
        if self._told_s < 0.0:
            return -1.0
        return self._told_s + (self._monotonic() - self._told_at) * self.speed


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
        """Whether it runs, or is about to be started again by the engine."""
        state = docker(
            "inspect", "--format", "{{.State.Running}} {{.State.Restarting}}", self._id(name)
        )
        return "true" in state

    def last_words(self, name: ParticipantId) -> str:
        """The end of its log."""
        return docker("logs", "--tail", "3", self._id(name))

    def wait(self) -> int:
        """Exit code of world-sim, once it has ended."""
        return int(docker("wait", self._id(WORLD_SIM)))

    def do(self, deed: ContainerCommand) -> None:
        """One deed."""
        container = self._id(deed.who)
        if deed.what == "cut":
            form = "{{range $name, $_ := .NetworkSettings.Networks}}{{$name}} {{end}}"
            self._cut[deed.who] = docker("inspect", "--format", form, container).split()
            for network in self._cut[deed.who]:
                docker("network", "disconnect", network, container)
        elif deed.what == "join":
            for network in self._cut.pop(deed.who, []):
                docker("network", "connect", "--alias", deed.who, network, container)
        else:
            docker(deed.what, container)


def docker(*arguments: str) -> str:
    """What a docker command prints. Raises ContainersError."""
    try:
        done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise ContainersError("docker: not installed") from None
    if done.returncode:
        problem = (done.stderr.strip() or "failed").splitlines()[-1]
        raise ContainersError(f"docker {' '.join(arguments[:2])}: {problem}")
    return str(done.stdout)
