"""Campaigns on real processes: storms of signals over the bus, and their reports."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from kantor_fleet.campaign import processes
from kantor_fleet.campaign.process_scenarios import (
    LOCKSTEP_EVERY,
    STORM_S,
    is_lockstep,
    process_scenario,
)
from kantor_fleet.campaign.processes import ProcessMission, Soak, SoakTerms, SoakTotals
from kantor_fleet.campaign.rss_monitor import Grown
from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.liars import Byzantine, liars_of
from kantor_protocol.scenario.faults.processes import Impostor, Kill, OnProcesses, Pause
from kantor_worldsim.world.world import WorldSetup
from support.limits import EVENT_LIMIT_S

if TYPE_CHECKING:
    from support.processes.command import Kantor

EVERYTHING = 260
"""A seed whose short storm has every class of faults of processes."""
SHORT_S = 16
SHOWN = (
    "late ", "slow ", "full-disk ", "clock ", "impostor ", "all rules held", "no process, no file", "rejoined", "below 600 s", "resumed    world-sim",
    "L1 judged 1", "L2 judged 1", "L3 judged 1",
)  # fmt: skip


def of_kind(faults: tuple[Fault, ...], kind: type[OnProcesses], who: str) -> int:
    """How many faults of a kind a participant has; robots ("r") count together."""
    names = [name for f in faults if isinstance(f, kind) for name in f.who]
    return sum(name == who or (who == "r" and name.startswith("r")) for name in names)


def test_any_fifteen_missions_in_a_row_have_every_signal_often_enough() -> None:
    """Any fifteen missions in a row have what a soak of a quarter of an hour must have seen."""
    storms = [process_scenario(seed) for seed in range(30)]
    walls = [s.faults for seed, s in enumerate(storms) if not is_lockstep(seed)]
    missions = 15 * (LOCKSTEP_EVERY - 1) // LOCKSTEP_EVERY
    assert missions * min(of_kind(faults, Kill, "r") for faults in walls) >= 100
    assert missions * min(of_kind(faults, Pause, "r") for faults in walls) >= 100
    assert missions * min(of_kind(faults, Kill, SUPERVISOR) for faults in walls) >= 20
    assert missions * min(of_kind(faults, Kill, WORLD_SIM) for faults in walls) >= 10


def test_a_hostile_robot_is_in_every_mission_if_wanted() -> None:
    """One of the team, with one lie or another; everybody signs, and nothing else is drawn differently."""
    told = set()
    for seed in range(12):
        plain, hostile = process_scenario(seed), process_scenario(seed, byzantine=True)
        (fault,) = hostile.faults[len(plain.faults) :]
        assert isinstance(fault, Byzantine)
        assert set(fault.who) <= set(plain.robot_ids)
        assert len(fault.who) == 1
        assert hostile.signed
        assert not liars_of(plain.faults)
        assert replace(hostile, faults=plain.faults, trust=plain.trust) == plain
        told.add(fault.lie)
    assert len(told) >= 3


@pytest.mark.parametrize("storm_s", [10.0, STORM_S, 120.0])
def test_faults_end_and_impostors_come_only_beside_the_original(storm_s: float) -> None:
    """After the storm no fault is left but one loss; an impostor comes only while its original runs."""
    for seed in range(20):
        scenario = process_scenario(seed, 4.0, storm_s)
        lost = [f for f in scenario.faults if f.until_s is None and not isinstance(f, Impostor)]
        assert all(isinstance(fault, Kill) for fault in lost)
        assert len(lost) <= 1
        longest_s = (5.0 if is_lockstep(seed) else 1.0) * 4.0 * storm_s
        assert max(f.until_s or f.from_s for f in scenario.faults) <= 1.001 * longest_s
        stops = [f for f in scenario.faults if isinstance(f, OnProcesses) and f.stops]
        for impostor in (f for f in scenario.faults if isinstance(f, Impostor)):
            apart = [f for f in stops if set(f.who) & {*impostor.who, WORLD_SIM}]
            assert not any(f.holds(impostor.from_ns) for f in apart)


def test_a_storm_over_real_processes_breaks_no_rule(kantor: "Kantor") -> None:
    """Every kind of process fault in one short mission: it ends, all rejoin, no process and no file is left.

    How soon they rejoin is a bound of soaks.
    """
    scenario = process_scenario(EVERYTHING, 8.0, SHORT_S)
    play(scenario, 0, WorldSetup.of(scenario, 0), [])  # a process that compiles kernels grows
    finished = kantor(
        "campaign", "--processes", "--seeds", f"{EVERYTHING}:{EVERYTHING + 1}", "--storm", SHORT_S,
        "--rejoin", EVENT_LIMIT_S,
    )  # fmt: skip
    assert finished.code == 0, finished.out + finished.err
    for shown in SHOWN:
        assert shown in finished.out, finished.out
    counts = finished.out.partition("signals")[2]
    for none in ("robots 0", "supervisor 0", "world-sim 0", " 0 torn", " 0 lost", " 0 mid-step"):
        assert none not in counts.partition("killed for good")[0]
    assert not list((kantor.folder / "campaign" / "processes").iterdir())


def test_a_storm_in_lockstep_has_the_digest_of_one_process(kantor: "Kantor") -> None:
    """One that is replayed keeps its folder, and verify holds."""
    finished = kantor("campaign", "--processes", "--replay", LOCKSTEP_EVERY - 1, "--storm", 10)
    assert finished.code == 0, finished.out + finished.err
    assert "(lockstep): done" in finished.out
    folder = kantor.folder / "campaign" / "processes" / f"seed-{LOCKSTEP_EVERY - 1}"
    assert kantor("verify", folder).code == 0


def test_the_first_violation_ends_a_soak_with_all_that_repeats_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seed, commit, command, and the folder that is kept."""

    def run_mission(seed: int, _terms: SoakTerms, folder: Path, *_: object) -> ProcessMission:
        folder.mkdir(parents=True)
        wrong = ("energy: t=1.000 s: r1: spends what it has not",) if seed == 2 else ()
        return ProcessMission(seed, "wall", "done", 1.0, wrong, Counter(kill=3), (0.5,), (1.0,))

    monkeypatch.setattr(processes, "run_mission", run_mission)
    monkeypatch.setattr(processes, "warm_up", lambda: None)
    code = processes.soak(Soak(range(5), tmp_path, SoakTerms(8.0, 40.0)))

    told = capsys.readouterr().out
    assert code == 1
    assert "3 missions" in told
    assert "VIOLATION  seed 2 (wall)\n  energy: t=1.000 s: r1: spends what it has not" in told
    assert "kantor campaign --processes --replay 2 --speed 8 --storm 40\n" in told
    assert "commit" in told
    assert [path.name for path in (tmp_path / "processes").iterdir()] == ["seed-2"]


@pytest.mark.parametrize(
    ("rejoined_s", "grown_mb", "met"),
    [(0.5, 0.5, True), (2.5, 0.5, False), (0.5, 50.0, False)],
    ids=["good", "slow to rejoin", "growing"],
)
def test_a_soak_is_met_if_all_are_back_in_time_and_memory_is_flat(
    rejoined_s: float, grown_mb: float, *, met: bool
) -> None:
    """The bounds are those that the totals print."""
    totals = SoakTotals()
    grown = {"robot": Grown(1, 1000, grown_mb, grown_mb, 100.0)}
    totals.add(ProcessMission(0, "wall", "done", 40.0, (), Counter(), (rejoined_s,), grown=grown))
    assert totals.met is met
    told = "\n".join(totals.lines(60.0))
    assert ("NOT" in told) is not met


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--storm", 5), "--storm 5: give 10 to 600 seconds"),
        (("--speed", 0), "--speed 0: give"),
        (("--rejoin", 0), "--rejoin 0: give a time above 0"),
    ],
)
def test_options_out_of_range_are_refused(
    kantor: "Kantor", arguments: tuple[object, ...], complaint: str
) -> None:
    """One line with the remedy."""
    refused = kantor("campaign", "--processes", *arguments)
    assert refused.code == 2
    assert complaint in refused.err
    assert len(refused.err.splitlines()) == 1
