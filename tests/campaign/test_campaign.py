"""Campaigns: fresh seeds hold; a violation is found, reported, replayed and shrunk."""

import re
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from campaign.mutants import MUTANTS
from kantor_agent.robots.density import DensityRobot
from kantor_fleet.campaign import run as campaigns
from kantor_fleet.campaign.draw import draw
from kantor_fleet.campaign.fault_coverage import CLASSES
from kantor_fleet.campaign.mission import Trial, attempt
from kantor_fleet.campaign.rare_events import RARE_EVENTS
from kantor_fleet.campaign.run import CampaignConfig, campaign, numbered, replay
from kantor_fleet.campaign.shrink import shrink
from kantor_fleet.campaign.totals import ENOUGH, Totals
from kantor_fleet.execution.experiment import Case
from kantor_fleet.execution.pools import Pool
from kantor_fleet.exits import Exit
from kantor_protocol.scenario.load import load
from kantor_worldsim.record.journal import read
from kantor_worldsim.record.run_folder import JOURNAL

FRESH = 120
"""Seeds that no earlier run has had: those of today."""

BUGS = {mutant.name: mutant for mutant in MUTANTS}


def here(cases: Iterable[Case]) -> Pool:
    """A pool in this process, so that a planted bug is in it."""
    for case in cases:
        yield case, attempt(case)


def today() -> int:
    """A base of seeds that changes daily; a failure names the seed itself."""
    return int(datetime.now(UTC).strftime("%Y%m%d")) * 1000


@pytest.mark.parametrize("part", range(3))
def test_fresh_seeds_hold(part: int) -> None:
    first = today() + part * FRESH // 3
    for seed in range(first, first + FRESH // 3):
        trial = attempt(Case(draw(seed), seed))
        assert trial.violation is None, f"kantor campaign --replay {seed}: {trial.violation}"


def test_a_campaign_goes_on_where_it_was_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = campaign(CampaignConfig(numbered("4"), tmp_path), here)
    assert first is Exit.DONE
    again: list[int] = []

    def noting(cases: Iterable[Case]) -> Pool:
        for case in cases:
            again.append(case.seed)
            yield case, attempt(case)

    assert campaign(CampaignConfig(numbered("2:6"), tmp_path), noting) is Exit.DONE
    assert again == [4, 5]
    printed = capsys.readouterr().out
    assert "2 missions are known" in printed
    assert re.search(r"\d+ robot-steps per CPU second", printed)
    assert all(name in printed for name in (*CLASSES, *RARE_EVENTS))


def test_a_violation_ends_a_campaign_with_all_that_repeats_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    BUGS["range-plus-five-percent"].plant(monkeypatch)
    monkeypatch.setattr(campaigns, "_SHRINK_S", 5.0)
    assert campaign(CampaignConfig(range(1000), tmp_path), here) is Exit.NOT_MET
    printed = capsys.readouterr().out
    found = re.search(r"VIOLATION  seed (\d+)", printed)
    assert found
    seed = int(found[1])
    assert f"kantor campaign --replay {seed}" in printed
    assert re.search(r"commit +\S+, sources [0-9a-f]{16}", printed)
    smallest = load(tmp_path / f"seed-{seed}" / "smallest.toml")
    assert smallest.robots.count <= draw(seed).robots.count
    assert len(smallest.faults) <= len(draw(seed).faults)
    assert attempt(Case(smallest, seed)).rule == "range"
    # What is known to be broken is not run again.
    assert campaign(CampaignConfig(range(1000), tmp_path), here) is Exit.NOT_MET
    assert replay(seed, tmp_path) is Exit.NOT_MET
    assert "VIOLATION  range:" in capsys.readouterr().out


def test_a_replay_leaves_a_run_folder(tmp_path: Path) -> None:
    assert replay(3, tmp_path) is Exit.DONE
    folder = tmp_path / "seed-3"
    assert load(folder / "scenario.toml") == draw(3)
    trial = attempt(Case(draw(3), 3))
    assert sum(1 for _ in read(folder / JOURNAL)) > 10
    assert (folder / "result.json").read_text().count(trial.digest) == 1


def test_shrinking_keeps_the_rule_and_drops_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    BUGS["impostor-let-in"].plant(monkeypatch)
    seed = next(s for s in range(100) if attempt(Case(draw(s), s)).rule == "epoch")
    smallest, trial = shrink(Case(draw(seed), seed), "epoch", most_s=10.0)
    assert trial.rule == "epoch"
    assert len(smallest.faults) == 1


def test_a_crash_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> str:
        raise RuntimeError("no such day")

    monkeypatch.setattr("kantor_fleet.campaign.mission.simulate", broken)
    trial = attempt(Case(draw(1), 1))
    assert trial.violation == "RuntimeError: no such day"
    assert trial.rule == "RuntimeError"


def test_state_that_contradicts_itself_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The participants of a campaign validate themselves; hunts for planted bugs do without."""
    seed = next(s for s in range(50) if not draw(s).mapping and not draw(s).faults)

    def validate(_: DensityRobot) -> None:
        raise AssertionError("more energy is spent than there was\n  details")

    monkeypatch.setattr(DensityRobot, "validate", validate, raising=False)
    trial = attempt(Case(draw(seed), seed))

    assert trial.rule == "invariant"
    assert trial.violation is not None
    assert trial.violation.endswith("s: r1: more energy is spent than there was")
    assert attempt(Case(draw(seed), seed), validate=False).violation is None


def test_what_was_never_reached_fails_a_long_campaign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    every = {"struck": dict.fromkeys(CLASSES, 1), "seen": dict.fromkeys(RARE_EVENTS, 1)}
    lacking = {**every, "seen": dict.fromkeys(RARE_EVENTS[1:], 1)}

    def invented(tallies: dict[str, dict[str, int]]) -> Exit:
        folder = tmp_path / str(len(tallies["seen"]))

        def made(cases: Iterable[Case]) -> Pool:
            for case in cases:
                yield case, Trial(sort="claims", **tallies)

        return campaign(CampaignConfig(range(ENOUGH), folder), made)

    assert invented(every) is Exit.DONE
    assert invented(lacking) is Exit.NOT_MET
    assert f"never reached: {RARE_EVENTS[0]}" in capsys.readouterr().out


def test_time_that_is_up_begins_nothing(tmp_path: Path) -> None:
    assert campaign(CampaignConfig(range(1000), tmp_path, minutes=1e-9), here) is Exit.DONE
    assert Totals().missing == (*CLASSES, *RARE_EVENTS)
