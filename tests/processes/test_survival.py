"""Process faults on the real bus: processes are killed, frozen, doubled and starved, and go on."""

import os
import shutil
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest

from kantor_protocol.transport.endpoint import free_endpoint
from kantor_worldsim.record.records import Batch, ProcessEvent
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import (
    acts_of,
    await_act,
    await_incident,
    await_line,
    await_text,
    children_named,
    incidents_of,
    records_of,
    result_of,
)

if TYPE_CHECKING:
    from support.processes.command import Kantor, Process

EVERYTHING = """
[[faults]]
kind = "late"
who = ["r4"]
until_s = 2.0

[[faults]]
kind = "kill"
who = ["r2"]
from_s = 5.0
until_s = 8.0

[[faults]]
kind = "kill"
who = ["r1"]
from_s = 6.0
until_s = 9.0
mid_step = true

[[faults]]
kind = "kill"
who = ["r3"]
from_s = 6.0
until_s = 8.5
disk = "torn"
mid_step = true

[[faults]]
kind = "kill"
who = ["r2"]
from_s = 11.0
until_s = 13.0
disk = "lost"

[[faults]]
kind = "full-disk"
who = ["r5"]
from_s = 7.0
until_s = 10.0

[[faults]]
kind = "slow"
who = ["r4"]
from_s = 9.0
until_s = 12.0
every = 4

[[faults]]
kind = "impostor"
who = ["r4"]
from_s = 14.0

[[faults]]
kind = "kill"
who = ["worldsim"]
from_s = 16.0
until_s = 18.0

[[faults]]
kind = "kill"
who = ["worldsim"]
from_s = 19.0
until_s = 19.5

[[faults]]
kind = "pause"
who = ["r1"]
from_s = 20.0
until_s = 26.0

[[faults]]
kind = "pause"
who = ["worldsim"]
from_s = 27.0
until_s = 28.0

[[faults]]
kind = "kill"
who = ["r5"]
from_s = 29.0
"""
SHORT = ("--set", "limit_s=34", "radio.range_m=500")
STARTS = [("r4", 0), ("r2", 0), ("r3", 1), ("r1", 0), ("r2", 1), ("worldsim", 0), ("worldsim", 0)]


@pytest.fixture
def doomed(kantor: "Kantor") -> "Kantor":
    """The kantor command in a folder with a schedule of everything."""
    (kantor.folder / "everything.toml").write_text(EVERYTHING)
    return kantor


def test_process_faults_over_the_bus_leave_the_record_of_one_process(doomed: "Kantor") -> None:
    """Real SIGKILLs, write-ahead logs that are torn and deleted, world-sim killed twice: the same bytes as in
    one process, and verify executes them once more.
    """
    for exchange in ("in-process", "lockstep"):
        finished = doomed(
            "run", "fleet", "--exchange", exchange, "--chaos", "everything.toml", *SHORT
        )
        assert "all rules held" in finished.out, finished.out + finished.err

    alone, bus = doomed.runs()
    assert result_of(alone)["digest"] == result_of(bus)["digest"]
    starts = [(i.who, i.incarnation) for i in incidents_of(bus) if i.kind == "start"]
    assert sorted(starts) == sorted(STARTS)
    log = (bus / "logs" / "worldsim.log").read_text()
    assert log.count("resumed") == 2
    assert "on the bus already" in (bus / "logs" / "r4-impostor.log").read_text()
    assert not (bus / "state").exists()
    assert doomed("verify", bus).code == 0


def test_process_faults_in_real_time_break_no_rule(doomed: "Kantor") -> None:
    """The same schedule in real time: every rule holds, all that were started again step again, and each
    incarnation replays from what it received.
    """
    finished = doomed(
        "run", "fleet", "--exchange", "wall", "--speed", 4, "--chaos", "everything.toml", *SHORT,
        "limit_s=50",
    )  # fmt: skip
    (folder,) = doomed.runs()
    assert "all rules held" in finished.out, finished.out + finished.err
    incidents = incidents_of(folder)
    starts = [incident for incident in incidents if incident.kind == "start"]
    assert sorted((i.who, i.incarnation) for i in starts) == sorted(STARTS)
    assert {i.kind for i in incidents} >= {
        "kill", "start", "pause", "resume", "fill", "free", "slow", "quicken", "pretend",
    }  # fmt: skip
    assert not [i for i in incidents if i.fault < 0]
    records = records_of(folder)
    ordered = {(2.0, "r4"), (8.0, "r2"), (9.0, "r1"), (8.5, "r3"), (13.0, "r2")}
    for due_s, who in ordered:
        back_ns = min(i.now_ns for i in starts if i.who == who and i.now_ns >= due_s * 1e9)
        assert any(step_record.now_ns > back_ns for step_record in acts_of(records, who))
    assert nothing_happens_between(records, "kill", "start", "worldsim")
    assert nothing_happens_between(records, "pause", "resume", "worldsim")
    full = [i.now_ns for i in incidents if i.kind in {"fill", "free"}]
    starved = [a for a in acts_of(records, "r5") if full[0] + 1e8 < a.now_ns < full[1]]
    assert starved == []
    verified = doomed("verify", folder)
    assert verified.code == 0, verified.out


def nothing_happens_between(records: list[object], first: str, last: str, who: str) -> bool:
    """Whether nothing is on record between what stopped a process and what had it go on."""
    inside = False
    for record in records:
        if isinstance(record, ProcessEvent) and record.who == who:
            inside = record.kind == first or (inside and record.kind != last)
        elif isinstance(record, Batch) and inside:
            return False
    return True


def test_robots_go_on_without_the_supervisor_and_with_it_again(kantor: "Kantor") -> None:
    """It is killed and started again with its write-ahead log; robots explore meanwhile."""
    (kantor.folder / "headless.toml").write_text(
        '[[faults]]\nkind = "kill"\nwho = ["supervisor"]\nfrom_s = 10.0\nuntil_s = 20.0\n'
    )
    process = kantor.start(
        "run", "paper-timevarying", "--exchange", "wall", "--speed", 8, "--chaos", "headless.toml",
        "--set", "limit_s=100000", "energy.points=50000", "energy.steps=50000",
    )  # fmt: skip
    await_line(process, "t=", "energy")
    (folder,) = kantor.runs()
    before = await_incident(folder, "supervisor", "start").now_ns
    await_act(folder, "supervisor", since_ns=before + 1)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)
    assert "all rules held" in out, out + err
    kill, start = incidents_of(folder)
    records = records_of(folder)
    meanwhile = [a for a in acts_of(records, "r1") if kill.now_ns < a.now_ns < start.now_ns]
    assert any(step_record.outputs and step_record.outputs.spent for step_record in meanwhile)
    assert [a for a in acts_of(records, "supervisor") if a.now_ns > start.now_ns]
    assert start.incarnation == 0


@pytest.mark.parametrize("exchange", ["lockstep", "wall"])
def test_a_killed_world_sim_goes_on_from_its_record(kantor: "Kantor", exchange: str) -> None:
    """SIGKILL from outside, twice: the mission goes on to its end; in lockstep with the same digest."""
    # It must not be over before it is killed.
    limit = "limit_s=200" if exchange == "lockstep" else "limit_s=60"
    mission = ("run", "fleet", "--seed", 3, *SHORT, limit)
    steps = 60 if exchange == "lockstep" else 20
    process = kantor.start(*mission, "--exchange", exchange, "--speed", 4)
    await_line(process, "t=", "energy")
    (folder,) = kantor.runs()
    for times in (1, 2):
        await_act(folder, "r1", steps * times)
        os.kill(pid_of(folder / "logs" / "worldsim.log"), signal.SIGKILL)
        await_text(folder / "logs" / "worldsim.log", "resumed", times)
    out, err = process.communicate(timeout=EVENT_LIMIT_S)

    assert "world-sim ended with signal 9; it goes on from its record" in out, err
    result = result_of(folder)
    ended = "done" if exchange == "lockstep" else "limit"
    assert (result["ended"], result["violations"], result["record"]) == (ended, 0, "whole")
    assert kantor("verify", folder).code == 0
    if exchange == "lockstep":
        kantor(*mission, "--exchange", "in-process")
        assert result_of(kantor.runs()[-1])["digest"] == result["digest"]
    else:
        told = [(i.who, i.kind) for i in incidents_of(folder) if i.who == "worldsim"]
        assert told == [("worldsim", "leave"), ("worldsim", "join")] * 2
        assert nothing_happens_between(records_of(folder), "leave", "join", "worldsim")


def pid_of(log: Path) -> int:
    """The last process that wrote a log."""
    return int(log.read_text().splitlines()[-1].partition('"pid": ')[2].partition(",")[0])


@pytest.fixture
def by_hand(kantor: "Kantor") -> "ByHand":
    """A world-sim and its robots, each started on its own."""
    return ByHand(kantor)


class ByHand:
    """A fleet that is started process by process."""

    def __init__(self, kantor: "Kantor") -> None:
        self.kantor = kantor
        self.endpoint = free_endpoint()
        self.world = self.start_world("fleet", "--set", "robots.count=2", "starts.random=true")
        await_line(self.world, "t=")
        self.robots = {name: self.start_robot(name) for name in ("r1", "r2")}
        (self.folder,) = kantor.runs()
        await_act(self.folder, "r2", 5)

    def start_world(self, *arguments: object) -> "Process":
        return self.kantor.start("worldsim", *arguments, "--listen", self.endpoint, "--speed", 2)

    def start_robot(self, name: str) -> "Process":
        return self.kantor.start("agent", name, "--connect", self.endpoint)

    def end(self) -> None:
        """Interrupt world-sim: the record is sound, and all robots end."""
        self.world.send_signal(signal.SIGINT)
        out, err = self.world.communicate(timeout=EVENT_LIMIT_S)
        assert self.world.returncode == 130, err
        assert "all rules held" in out, out
        for robot in self.robots.values():
            assert robot.wait(timeout=EVENT_LIMIT_S) == 0
        assert self.kantor("verify", self.folder).code == 0


def test_a_robot_that_is_killed_and_started_again_goes_on_where_it_was(by_hand: ByHand) -> None:
    """With its write-ahead log as the same incarnation; without, as the next one; r1 goes on meanwhile."""
    for incarnation in (0, 1):
        by_hand.robots["r2"].kill()
        left = await_incident(by_hand.folder, "r2", "leave", incarnation + 1)
        if incarnation:
            (by_hand.kantor.folder / "state" / "r2.diary").unlink()
        by_hand.robots["r2"] = by_hand.start_robot("r2")
        joined = await_incident(by_hand.folder, "r2", "join", incarnation + 1)
        before = acts_of(records_of(by_hand.folder), "r2")
        assert (joined.incarnation, joined.fault) == (incarnation, -1)
        assert joined.step >= sum(step_record.now_ns < left.now_ns for step_record in before)
        await_act(by_hand.folder, "r2", joined.step + 3)

    by_hand.end()


def test_a_frozen_robot_goes_on_unless_it_has_a_successor(by_hand: ByHand) -> None:
    """Frozen for longer than a lease it is back by itself; with a successor it is sent away, and the two
    never share a write-ahead log.
    """
    frozen = by_hand.robots["r2"]
    frozen.send_signal(signal.SIGSTOP)
    await_incident(by_hand.folder, "r2", "leave")
    frozen.send_signal(signal.SIGCONT)
    assert await_incident(by_hand.folder, "r2", "join").incarnation == 0
    steps = len(acts_of(records_of(by_hand.folder), "r2"))
    await_act(by_hand.folder, "r2", steps + 2)

    frozen.send_signal(signal.SIGSTOP)
    await_incident(by_hand.folder, "r2", "leave", 2)
    by_hand.robots["r2"] = by_hand.start_robot("r2")
    assert await_incident(by_hand.folder, "r2", "join", 2).incarnation == 1
    frozen.send_signal(signal.SIGCONT)
    _, complaint = frozen.communicate(timeout=EVENT_LIMIT_S)
    assert frozen.returncode == 2
    assert "another process has taken its place" in complaint

    by_hand.end()


def test_a_standalone_world_sim_resumes_a_run_folder(by_hand: ByHand) -> None:
    """Killed, then `--resume`: robots have held, and go on; r2, which died meanwhile, comes back too."""
    by_hand.world.kill()
    by_hand.world.wait()
    by_hand.robots["r2"].kill()
    before = records_of(by_hand.folder)
    with (by_hand.folder / "run.mcap").open("ab") as journal:
        journal.write(b"\x05\x40\x00")  # the beginning of a message
    by_hand.robots["r2"] = by_hand.start_robot("r2")
    by_hand.world = by_hand.start_world("--resume", by_hand.folder)
    await_act(by_hand.folder, "r2", len(acts_of(before, "r2")) + 5)
    after = records_of(by_hand.folder)

    assert after[: len(before)] == before
    assert not list(by_hand.folder.glob(".*.draft"))
    by_hand.end()
    assert len(by_hand.kantor.runs()) == 1


def test_impossible_commands_are_refused_in_a_line(kantor: "Kantor") -> None:
    """Process faults without a process controller, no place for a write-ahead log, folders to resume nothing from."""
    (kantor.folder / "kill.toml").write_text(
        '[[faults]]\nkind = "kill"\nwho = ["r1"]\nfrom_s = 1.0\n'
    )
    (kantor.folder / "file").write_text("")
    refused = kantor("worldsim", "fleet", "--chaos", "kill.toml")
    assert (refused.code, refused.err) == (
        2, "kantor: faults[0]: kill: needs control over the processes of participants; use `kantor run`\n",
    )  # fmt: skip

    endpoint = free_endpoint()
    world = kantor.start("worldsim", "paper-single", "--listen", endpoint)
    await_line(world, "t=")
    refused = kantor("agent", "r1", "--connect", endpoint, "--state", "file/below")
    assert refused.code == 2
    assert "file/below: no write-ahead log can be kept there (Not a directory)" in refused.err
    world.kill()
    world.wait()

    assert kantor("run", "paper-single", "--exchange", "in-process", "--set", "limit_s=5").code == 1
    over = kantor.runs()[-1]
    for folder, complaint in (
        ("nowhere", "no run to go on with"),
        (over, "its mission is over (limit)"),
    ):
        refused = kantor("worldsim", "--resume", folder)
        assert refused.code == 2
        assert complaint in refused.err
        assert len(refused.err.splitlines()) == 1


def test_a_slow_reader_does_not_fill_world_sims_memory(kantor: "Kantor") -> None:
    """Two robots of three are frozen while the third speaks at length: world-sim's memory is flat."""
    (kantor.folder / "frozen.toml").write_text(
        '[[faults]]\nkind = "pause"\nwho = ["r2", "r3"]\nfrom_s = 2.0\nuntil_s = 90000.0\n'
    )
    process = kantor.start(
        "run", "fleet", "--exchange", "wall", "--speed", 40, "--chaos", "frozen.toml", "--set",
        "robots.count=3", "starts.random=true", "radio.range_m=inf", "radio.beacon='state'",
        "limit_s=100000",
    )  # fmt: skip
    await_line(process, "t=", "energy")
    (folder,) = kantor.runs()
    world = psutil.Process(children_named(process, folder / "logs" / "worldsim.log"))
    await_act(folder, "r1", 300)
    before = world.memory_info().rss
    await_act(folder, "r1", 2500)
    grown = world.memory_info().rss - before
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=EVENT_LIMIT_S)
    shutil.rmtree(folder)

    assert grown < 30e6
