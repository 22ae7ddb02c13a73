"""Whole missions with the planner `market`."""

import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.record.records import Batch, Record
from kantor_worldsim.world.world import WorldSetup
from support.teams.markets import mission

UNSTRUCTURED = (
    "map.layout=unstructured",
    "map.size_m=[48.0, 48.0]",
    "starts.spread=together",
    "sensor.range_m=6.0",
    "sensor.beams=90",
    "vehicle.speed_m_s=1.0",
    "limit_s=2000.0",
)
BAD_RADIO = (
    "radio.range_m=15.0",
    "radio.drop=0.3",
    "radio.duplicate=0.2",
    "radio.delay_s=1.0",
    "radio.jitter_s=2.0",
)


def ending_and_targets(
    scenario: Scenario, seed: int
) -> tuple[str, dict[str, list[tuple[float, float]]]]:
    """The reason for which a mission ended, and the targets of each robot, one after another."""
    targets: dict[str, list[tuple[float, float]]] = {name: [] for name in scenario.robot_ids}

    def add_targets(record: Record) -> None:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            goal = step_record.outputs and step_record.outputs.goal
            if goal and targets[step_record.name][-1:] != [goal]:
                targets[step_record.name].append(goal)

    return play(scenario, seed, WorldSetup.of(scenario, seed), [add_targets]), targets


@pytest.mark.parametrize("rule", ["random", "greedy", "quadtree"])
@pytest.mark.parametrize(
    "overrides",
    [("coordination=centralized",), (), BAD_RADIO],
    ids=["centralized", "decentralized", "bad-radio"],
)
def test_mission_ends_and_targets_do_not_oscillate(rule: str, overrides: tuple[str, ...]) -> None:
    """All is explored; of a robot's targets hardly one in ten is one of the four before it."""
    scenario = mission(*UNSTRUCTURED, *overrides, f"planner.goals={rule}")
    reason, targets = ending_and_targets(scenario, 1)

    assert reason == "done"
    back = [
        goal in goals[max(0, i - 4) : i]
        for goals in targets.values()
        for i, goal in enumerate(goals)
    ]
    assert sum(back) <= 0.1 * len(back)
