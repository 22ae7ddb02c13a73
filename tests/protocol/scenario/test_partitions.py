"""Partitions and one-way faults: which links each shape cuts."""

from itertools import permutations

import pytest

from kantor_protocol.scenario.faults.links import OneWay, Partition


def cut_links(partition: Partition | OneWay, robots: int, *, centralized: bool = False) -> set[str]:
    """Links that are cut, as sender>receiver with r and the supervisor in short."""
    roster = tuple(f"r{i}" for i in range(1, robots + 1))
    roster += ("supervisor",) if centralized else ()
    severs = partition.severs(roster)
    return {f"{one[-1]}{other[-1]}" for one, other in permutations(roster, 2) if severs(one, other)}


def both_ways(*links: str) -> set[str]:
    return {link for each in links for link in (each, each[::-1])}


@pytest.mark.parametrize(
    ("partition", "robots", "links"),
    [
        (Partition(shape="halves"), 2, both_ways("12")),
        (Partition(shape="halves"), 3, both_ways("13", "23")),
        (Partition(shape="halves"), 4, both_ways("13", "14", "23", "24")),
        (Partition(shape="ring"), 4, both_ways("13", "24")),
        (Partition(shape="ring"), 5, both_ways("13", "14", "24", "25", "35")),
        (Partition(shape="bridge"), 3, both_ways("13")),
        (Partition(shape="bridge"), 4, both_ways("14", "24")),
        (Partition(shape="bridge"), 5, both_ways("14", "15", "24", "25")),
        (Partition(shape="isolate", robots=("r2",)), 3, both_ways("12", "23")),
        (Partition(shape="isolate", robots=("r1", "r2")), 3, both_ways("12", "13", "23")),
        (Partition(shape="groups", groups=(("r1", "r3"),)), 4, both_ways("12", "14", "32", "34")),
        (Partition(shape="groups", groups=(("r1",), ("r2",))), 3, both_ways("12", "13", "23")),
        (OneWay(senders=("r1",)), 3, {"12", "13"}),
        (OneWay(receivers=("r1",)), 3, {"21", "31"}),
        (OneWay(senders=("r1", "r2"), receivers=("r2", "r3")), 3, {"12", "13", "23"}),
    ],
)
def test_shapes_cut_their_links(
    partition: Partition | OneWay, robots: int, links: set[str]
) -> None:
    assert cut_links(partition, robots) == links


def test_supervisor_is_the_last_of_the_roster() -> None:
    halves = Partition(shape="halves")

    assert cut_links(halves, 3, centralized=True) == both_ways("13", "1r", "23", "2r")
