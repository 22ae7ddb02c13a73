"""The way to a target: round the walls, and always getting shorter."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.mapping.navigation import Navigator
from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN
from kantor_protocol.base.machine import Pose
from support.strategies import examples
from support.teams.floors import Floor, crowded, drawn


def drive(floor: Floor, start: int, target: int, stride_m: float) -> list[tuple[Pose, float]]:
    """Where the robot is, and how far it still is, until it is there."""
    navigator, frame = Navigator(floor.cost_map), floor.fused_map.frame
    pose, end_m = Pose(*frame.centre_of(start)), frame.centre_of(target)
    passed = []
    for _ in range(10_000):
        place_m = navigator.head(pose, target)
        assert place_m is not None
        passed.append((pose, navigator.left_cells))
        if (pose.x_m, pose.y_m) == end_m:
            break
        away_m = math.dist(place_m, (pose.x_m, pose.y_m))
        share = min(1.0, stride_m / away_m) if away_m else 1.0
        x_m, y_m = (a + share * (b - a) for a, b in zip((pose.x_m, pose.y_m), place_m, strict=True))
        pose = Pose(x_m, y_m) if share < 1.0 else Pose(*place_m)
    return passed


@examples(100)
@given(data=st.data(), stride_m=st.floats(0.05, 3.0))
def test_a_robot_arrives_and_the_way_left_never_gets_longer(
    data: st.DataObject, stride_m: float
) -> None:
    """However slow it is, and however far ahead it sees: otherwise it would seem to be stuck."""
    floor, situation = data.draw(crowded())
    start = situation.members[0].cell
    reached = [c for c, v in enumerate(floor.cost_map.travel(start).tolist()) if v < math.inf]
    if not reached:
        return
    target = data.draw(st.sampled_from(reached))
    passed = drive(floor, start, target, stride_m)
    left = [cells for _, cells in passed]

    assert left[-1] == 0.0
    assert left[0] <= floor.cost_map.travel(start)[target] + 1e-9
    assert all(after <= before + 1e-9 for before, after in pairwise(left))
    for pose, _ in passed[1:]:  # a robot stands where it stands
        cell = floor.fused_map.frame.cell_of(pose.x_m, pose.y_m)
        assert cell == start or floor.fused_map.cells[cell] == FREE


def test_the_way_left_is_measured_along_the_way() -> None:
    """A long diagonal is as long as it is, not as many cells as it has."""
    floor = drawn(["." * 100] * 100)
    left = [cells for _, cells in drive(floor, 0, 9999, 1.0)]

    assert left[:5] == pytest.approx([99 * math.sqrt(2.0) - i for i in range(5)])


def test_no_way_leads_through_walls_or_unknown_cells() -> None:
    """Nor to where nothing leads."""
    for kind in (OCCUPIED, UNKNOWN):
        floor = drawn(["...", {OCCUPIED: "###", UNKNOWN: "   "}[kind], "..."])
        assert Navigator(floor.cost_map).head(Pose(0.5, 0.5), 8) is None


def test_a_wall_that_appears_is_driven_round() -> None:
    """The way is found anew."""
    floor = drawn(["...", "...", "..."])
    navigator, pose = Navigator(floor.cost_map), Pose(0.5, 0.5)
    assert navigator.head(pose, 6) == (0.5, 2.5)
    floor.see([3, 4], OCCUPIED)

    assert navigator.head(pose, 6) == (2.5, 0.5)
