"""Faults as data: read, written, and set; any value in any place is refused or read."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.dump import to_toml, to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.faults.schedule import KINDS
from kantor_protocol.scenario.load import from_tree, parse
from support.faults.fault_tables import EVERY_KIND, fault
from support.strategies import SMALL, TOML_KEYS, TOML_VALUES, examples, mission, paths_of, planted


def test_every_kind_is_read_and_written() -> None:
    scenario = parse(SMALL + EVERY_KIND, "small")

    assert {type(each) for each in scenario.faults} == set(KINDS.values())
    assert parse(to_toml(scenario), "written") == scenario
    assert from_tree(to_tree(scenario), "tree") == scenario


def test_windows_are_in_nanoseconds_and_open_by_default() -> None:
    burst, drop = parse(SMALL + EVERY_KIND, "small").faults[1::-1]

    assert (burst.from_ns, burst.until_ns) == (1_000_000_000, 9_500_000_000)
    assert (drop.from_ns, drop.until_ns) == (0, None)


def test_faults_can_be_set() -> None:
    """A list in TOML, as for every other key."""
    assert mission(fault(kind="drop", probability=1)).faults[0].until_s is None
    assert mission(fault(kind="drop", probability=1), "faults=[]").faults == ()


def check_refused_or_written(tree: Any) -> None:
    scenario, message = None, ""
    try:
        scenario = from_tree(tree, "any")
    except ScenarioError as error:
        message = str(error)
    if scenario is None:
        assert len(message.splitlines()) == 1
    else:
        assert parse(to_toml(scenario), "written") == scenario


TREE = to_tree(parse(SMALL + EVERY_KIND, "small"))
PLACES = [("faults", *path) for path in paths_of(TREE["faults"])]


@examples(300)
@given(path=st.sampled_from(PLACES), value=TOML_VALUES)
def test_any_value_in_any_place_is_refused_or_a_scenario(
    path: tuple[str | int, ...], value: Any
) -> None:
    check_refused_or_written(planted(TREE, path, value))


@examples(100)
@given(i=st.integers(0, len(TREE["faults"]) - 1), key=TOML_KEYS, value=TOML_VALUES)
def test_any_key_in_any_fault_is_refused_or_a_scenario(i: int, key: str, value: Any) -> None:
    check_refused_or_written(planted(TREE, ("faults", i), {**TREE["faults"][i], key: value}))
