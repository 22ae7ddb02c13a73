"""Faults as data: read, written, and refused in one line when they cannot apply."""

from collections.abc import Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.dump import to_toml, to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.faults.links import OneWay, Partition
from kantor_protocol.scenario.faults.schedule import KINDS
from kantor_protocol.scenario.load import from_tree, parse, with_chaos
from kantor_protocol.scenario.schema import Scenario
from support.grounds import exploration
from support.strategies import SMALL, TOML_KEYS, TOML_VALUES, examples, mission, paths_of, planted

EVERY_KIND = """
[[faults]]
kind = "drop"
probability = 0.25
robots = ["r1"]

[[faults]]
kind = "burst"
from_s = 1
until_s = 9.5
good_s = 2.0
bad_s = 0.5
drop_bad = 0.9

[[faults]]
kind = "delay"
delay_s = 0.2
jitter_s = 0.1

[[faults]]
kind = "duplicate"
probability = 1.0
copies = 3

[[faults]]
kind = "replay"
probability = 0.5
age_s = 3.0

[[faults]]
kind = "reorder"
probability = 0.5
hold_s = 1.0

[[faults]]
kind = "one-way"
senders = ["r1"]
receivers = ["r2", "r3"]

[[faults]]
kind = "partition"
shape = "groups"
groups = [["r1"], ["r2", "r3"]]
flap_s = 1.5

[[faults]]
kind = "clog"
until_s = 4.0

[[faults]]
kind = "bandwidth"
bytes_per_s = 1000.0
queue_bytes = 0

[[faults]]
kind = "range"
range_m = 12.0

[[faults]]
kind = "hostile"
probability = 0.1

[[faults]]
kind = "kill"
who = ["r1", "r2"]
from_s = 1.0
until_s = 2.0
disk = "torn"
mid_step = true

[[faults]]
kind = "pause"
who = ["r1"]
from_s = 2.0
until_s = 3.0

[[faults]]
kind = "late"
who = ["r3"]
until_s = 0.5

[[faults]]
kind = "slow"
who = ["r3"]
from_s = 4.0
every = 3

[[faults]]
kind = "full-disk"
who = ["r1", "r2"]
from_s = 5.0
until_s = 6.0

[[faults]]
kind = "clock"
who = ["r1", "r3"]
from_s = 0.5
offset_s = -3.0
rate_ppm = 100.0

[[faults]]
kind = "impostor"
who = ["r2"]
from_s = 3.0

[[faults]]
kind = "kill"
who = ["worldsim"]
from_s = 8.0
until_s = 9.0
"""


Entry = dict[str, Any]
"""A fault as a table."""


def refusal(text: str, *overrides: str) -> str:
    """What is said of a scenario with such faults: one line that begins with the place."""
    with pytest.raises(ScenarioError) as caught:
        parse(SMALL + text, "small", overrides)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message.removeprefix("small: ")


def fault(**values: Any) -> str:
    """One fault as `--set` takes it."""
    pairs = ", ".join(f"{key} = {value!r}" for key, value in values.items())
    return f"faults=[{{{pairs}}}]"


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


REFUSED = {
    "no kind": ({"from_s": 1}, "faults[0].kind: missing; set it; known: bandwidth, burst,"),
    "unknown kind": ({"kind": "flood"}, "faults[0].kind: 'flood' is not known; known: bandwidth"),
    "kind of number": ({"kind": 3}, "faults[0].kind: expected `str`, got `int`"),
    "misspelt key": (
        {"kind": "drop", "probability": 0.5, "robot": ["r1"]},
        "faults[0].robot: no such key; did you mean robots?",
    ),
    "key of another kind": (
        {"kind": "clog", "until_s": 1, "shape": "ring"},
        "faults[0].shape: no such key; known: from_s, until_s, robots",
    ),
    "missing key": ({"kind": "drop"}, "faults[0].probability: missing; set it"),
    "impossible": ({"kind": "drop", "probability": 1.5}, "faults[0].probability: expected `float`"),
    "never": ({"kind": "drop", "probability": 0.0}, "faults[0].probability: expected `float` >"),
    "before": ({"kind": "drop", "probability": 1, "from_s": -1}, "faults[0].from_s: expected"),
    "nan": ({"kind": "delay", "delay_s": float("nan")}, "faults[0].delay_s: "),
    "backwards": (
        {"kind": "drop", "probability": 1, "from_s": 5, "until_s": 5},
        "faults[0].until_s: 5 s is not after from_s, 5 s; set a later end",
    ),
    "too late": (
        {"kind": "drop", "probability": 1, "from_s": 17},
        "faults[0].from_s: 17 s is never reached; the mission is cut at 16.5 s",
    ),
    "unknown robot": (
        {"kind": "drop", "probability": 1, "robots": ["r2", "r9"]},
        "faults[0].robots: r9 is not in the team; known: r1 to r3",
    ),
    "absent supervisor": (
        {"kind": "one-way", "senders": ["supervisor"]},
        "faults[0].senders: supervisor is not in the team; known: r1 to r3",
    ),
    "named twice": (
        {"kind": "drop", "probability": 1, "robots": ["r2", "r2"]},
        "faults[0].robots: r2 is named twice; name it once",
    ),
    "no delay": ({"kind": "delay"}, "faults[0].delay_s: delays nothing; set it, or jitter_s"),
    "one-way to all": ({"kind": "one-way"}, "faults[0].senders: missing; set senders, receivers"),
    "one-way to itself": (
        {"kind": "one-way", "senders": ["r1"], "receivers": ["r1"]},
        "faults[0].receivers: no link leads there from the senders; name others",
    ),
    "a share of no flapping": (
        {"kind": "partition", "shape": "halves", "flap_share": 0.25},
        "faults[0].flap_share: only with flap_s; set it",
    ),
    "unknown shape": (
        {"kind": "partition", "shape": "star"},
        "faults[0].shape: 'star' is not known; known: halves, ring, bridge, isolate, groups",
    ),
    "whom to isolate": (
        {"kind": "partition", "shape": "isolate"},
        "faults[0].robots: missing; set it",
    ),
    "groups of halves": (
        {"kind": "partition", "shape": "halves", "groups": [["r1"]]},
        'faults[0].groups: only with shape = "groups"',
    ),
    "joint groups": (
        {"kind": "partition", "shape": "groups", "groups": [["r1", "r2"], ["r2"]]},
        "faults[0].groups: r2 is named twice",
    ),
    "empty group": (
        {"kind": "partition", "shape": "groups", "groups": [["r1"], []]},
        "faults[0].groups[1]: empty; name a participant",
    ),
    "all together": (
        {"kind": "partition", "shape": "groups", "groups": [["r1", "r2", "r3"]]},
        "faults[0].shape: groups cuts no link of a team of 3",
    ),
    "ring of three": (
        {"kind": "partition", "shape": "ring"},
        "faults[0].shape: ring cuts no link of a team of 3",
    ),
    "endless clog": ({"kind": "clog"}, "faults[0].until_s: missing; a clog needs an end"),
    "trickle": ({"kind": "bandwidth", "bytes_per_s": 1e-9}, "faults[0].bytes_per_s: 1e-09 is"),
    "no range": ({"kind": "range"}, "faults[0].range_m: set either range_m or factor"),
    "two ranges": (
        {"kind": "range", "range_m": 1.0, "factor": 0.5},
        "faults[0].range_m: set either range_m or factor",
    ),
    "nothing hostile": (
        {"kind": "hostile", "probability": 0.0},
        "faults[0].probability: expected `float` > 0.0",
    ),
    "kill of whom": ({"kind": "kill"}, "faults[0].who: missing; set it"),
    "kill of nobody": ({"kind": "kill", "who": []}, "faults[0].who: expected `array` of length >="),
    "kill of a stranger": (
        {"kind": "kill", "who": ["r1", "r9"]},
        "faults[0].who: r9 is not in the team; known: r1 to r3",
    ),
    "kill of no supervisor": (
        {"kind": "kill", "who": ["supervisor"]},
        "faults[0].who: supervisor is not in the team; known: r1 to r3",
    ),
    "killed twice at once": (
        {"kind": "kill", "who": ["r1", "r1"]},
        "faults[0].who: r1 is named twice; name it once",
    ),
    "kill before the start": (
        {"kind": "kill", "who": ["r1"], "from_s": -1},
        "faults[0].from_s: expected `float` >= 0.0",
    ),
    "kill after the end": (
        {"kind": "kill", "who": ["r1"], "from_s": 17},
        "faults[0].from_s: 17 s is never reached; the mission is cut at 16.5 s",
    ),
    "start before the kill": (
        {"kind": "kill", "who": ["r1"], "from_s": 3, "until_s": 2},
        "faults[0].until_s: 2 s is not after from_s, 3 s; set a later end",
    ),
    "unknown disk": (
        {"kind": "kill", "who": ["r1"], "disk": "burnt"},
        "faults[0].disk: 'burnt' is not known; known: kept, torn, lost",
    ),
    "kill of the world for good": (
        {"kind": "kill", "who": ["worldsim"], "from_s": 1},
        "faults[0].until_s: missing; a mission cannot end without world-sim",
    ),
    "world that forgets": (
        {"kind": "kill", "who": ["worldsim"], "until_s": 1, "disk": "lost"},
        "faults[0].disk: only for participants; leave it out for worldsim",
    ),
    "world killed in a step": (
        {"kind": "kill", "who": ["worldsim"], "until_s": 1, "mid_step": True},
        "faults[0].mid_step: only for participants; leave it out for worldsim",
    ),
    "endless pause": (
        {"kind": "pause", "who": ["r1"]},
        "faults[0].until_s: missing; a pause needs an end",
    ),
    "endlessly full": (
        {"kind": "full-disk", "who": ["r1"]},
        "faults[0].until_s: missing; a full-disk needs an end",
    ),
    "full disk of the world": (
        {"kind": "full-disk", "who": ["worldsim"], "until_s": 1},
        "faults[0].who: worldsim is not in the team; known: r1 to r3",
    ),
    "endlessly late": (
        {"kind": "late", "who": ["r1"]},
        "faults[0].until_s: missing; a late needs an end",
    ),
    "late in the middle": (
        {"kind": "late", "who": ["r1"], "from_s": 1, "until_s": 2},
        "faults[0].from_s: a late joiner is missing from the start; leave it out",
    ),
    "everybody late": (
        {"kind": "late", "who": ["r3", "r1", "r2"], "until_s": 2},
        "faults[0].who: no robot would be there at the start; leave one out",
    ),
    "slow as ever": (
        {"kind": "slow", "who": ["r1"], "every": 1},
        "faults[0].every: expected `int` >= 2",
    ),
    "slow without a rate": ({"kind": "slow", "who": ["r1"]}, "faults[0].every: missing; set it"),
    "right clock": (
        {"kind": "clock", "who": ["r1"], "rate_ppm": 0.4},
        "faults[0].offset_s: the clock is right; set it, or rate_ppm",
    ),
    "clock of another day": (
        {"kind": "clock", "who": ["r1"], "offset_s": 4000.0},
        "faults[0].offset_s: expected `float` <= 3600.0",
    ),
    "impostor that stays": (
        {"kind": "impostor", "who": ["r1"], "from_s": 1, "until_s": 2},
        "faults[0].until_s: an impostor asks once, at from_s; leave it out",
    ),
    "impostor of the world": (
        {"kind": "impostor", "who": ["worldsim"]},
        "faults[0].who: worldsim is not in the team; known: r1 to r3",
    ),
    "half of infinity": (
        {"kind": "range", "factor": 0.5},
        "faults[0].factor: radio.range_m is infinite and stays so; set range_m",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_apply_is_refused(name: str) -> None:
    """One line: which entry, which key, what to do about it."""
    values, says = REFUSED[name]
    tree = {**to_tree(mission()), "faults": [values]}
    with pytest.raises(ScenarioError) as caught:
        from_tree(tree, "small")

    assert str(caught.value).startswith(f"small: {says}")


def test_the_entry_is_counted() -> None:
    text = EVERY_KIND + '[[faults]]\nkind = "drop"\nprobability = 1\nuntil_s = 0\n'

    place = EVERY_KIND.count("[[faults]]")
    assert refusal(text).startswith(f"faults[{place}].until_s: 0 s is not after from_s, 0 s")


def test_range_must_shrink() -> None:
    """The one that counts: the supervisor's in a centralized mission."""
    shrunk = fault(kind="range", range_m=50.0)

    assert refusal("", "radio.range_m=50", shrunk) == (
        "faults[0].range_m: radio.range_m is 50 m already; set a shorter one"
    )
    assert "supervisor.range_m is 9 m already" in refusal(
        "", "coordination=centralized", "supervisor.range_m=9", shrunk
    )
    assert mission("coordination=centralized", shrunk).faults


def test_nowhere_is_in_no_range() -> None:
    """A supervisor without a place on the map."""
    with pytest.raises(ScenarioError, match="the supervisor has no place on the map"):
        exploration("coordination=centralized", fault(kind="range", range_m=5.0))


# Two that cannot go together.


def process(kind: str, who: str, *window: float, **more: Any) -> Entry:
    """An entry that befalls one process within a window."""
    return {
        "kind": kind,
        "who": [who],
        **dict(zip(("from_s", "until_s"), window, strict=False)),
        **more,
    }


def kill(who: str, *window: float, **more: Any) -> Entry:
    return process("kill", who, *window, **more)


TOGETHER = {
    "two kills": (
        (kill("r1", 1, 3), kill("r1", 2, 4)),
        "faults[1].who: r1 has a kill then already, by faults[0]; move one of the two",
    ),
    "listed late": (
        (kill("r1", 2, 4), kill("r1", 1, 3)),
        "faults[1].who: r1 has a kill then already, by faults[0]; move one of the two",
    ),
    "kill of the dead": (
        (kill("r2", 1), kill("r1", 1), kill("r2", 9, 10)),
        "faults[2].who: r2 has a kill then already, by faults[0]; move one of the two",
    ),
    "pause of the dead": (
        (kill("r1", 1, 3), process("pause", "r1", 2, 4)),
        "faults[1].who: r1 has a kill then already, by faults[0]; move one of the two",
    ),
    "kill of whom is not there": (
        (process("late", "r1", 0, 2), kill("r1", 1, 3)),
        "faults[1].who: r1 has a late then already, by faults[0]; move one of the two",
    ),
    "paused and slow": (
        (process("slow", "r1", every=2), process("pause", "r1", 2, 4)),
        "faults[1].who: r1 has a slow then already, by faults[0]; move one of the two",
    ),
    "full disk of the dead": (
        (process("full-disk", "r1", 1, 3), kill("r1", 2)),
        "faults[1].who: r1 has a full-disk then already, by faults[0]; move one of the two",
    ),
    "two ends of the world": (
        (kill("worldsim", 1, 3), process("pause", "worldsim", 2, 4)),
        "faults[1].who: worldsim has a kill then already, by faults[0]; move one of the two",
    ),
    "unseen death": (
        (kill("worldsim", 1, 3), kill("r1", 2, 4)),
        "faults[1]: world-sim is down at from_s of a kill, see faults[0]; move it",
    ),
    "unseen return": (
        (kill("r1", 1, 3), process("pause", "worldsim", 2, 4)),
        "faults[1]: world-sim is down at until_s of a kill, see faults[0]; move it",
    ),
    "impostor of the dead": (
        (process("impostor", "r1", 2), kill("r1", 1, 3)),
        "faults[1]: r1 is away when its impostor joins, which would be admitted, see faults[0]; move it",
    ),
}


def said_of(faults: Sequence[Entry], *overrides: str) -> str:
    """What is wrong with a list of faults; empty if nothing is."""
    try:
        from_tree({**to_tree(mission(*overrides)), "faults": list(faults)}, "small")
    except ScenarioError as error:
        return str(error).removeprefix("small: ")
    return ""


@pytest.mark.parametrize("name", TOGETHER)
def test_what_cannot_go_together_is_refused(name: str) -> None:
    faults, says = TOGETHER[name]

    assert said_of(faults) == says


@pytest.mark.parametrize(
    "faults",
    [
        (kill("r1", 1, 3), kill("r1", 3, 4)),
        (kill("r1", 1, 3), kill("r2", 2, 4)),
        (kill("r1", 1, 3), process("clock", "r1", 2, 4, offset_s=1.0)),
        (kill("r1", 1, 3), process("impostor", "r1", 3)),
        (kill("worldsim", 1, 3), kill("r1", 3, 4)),
        (kill("r1", 1, 5), process("pause", "worldsim", 2, 4)),
        (process("pause", "worldsim", 1, 3), process("pause", "r1", 2, 4)),
    ],
)
def test_what_can_go_together_is_a_mission(faults: tuple[Entry, ...]) -> None:
    assert said_of(faults) == ""


WINDOWS = st.tuples(st.integers(0, 8), st.integers(1, 4)).map(lambda w: (w[0], w[0] + w[1]))


@examples(100)
@given(windows=st.lists(WINDOWS, min_size=1, max_size=4), pauses=st.sets(st.integers(0, 3)))
def test_nobody_is_stopped_twice_at_once(windows: list[tuple[int, int]], pauses: set[int]) -> None:
    """Refused if, and only if, two windows share a moment."""
    faults = [
        process("pause" if i in pauses else "kill", "r2", *window)
        for i, window in enumerate(windows)
    ]
    shared = any(one[0] < two[1] and two[0] < one[1] for one, two in combinations(windows, 2))

    assert bool(said_of(faults)) == shared


# Partitions.


def cut(partition: Partition | OneWay, robots: int, *, centralized: bool = False) -> set[str]:
    """Links that are cut, as sender>receiver with r and the supervisor in short."""
    roster = tuple(f"r{i}" for i in range(1, robots + 1))
    roster += ("supervisor",) if centralized else ()
    severs = partition.severs(roster)
    return {f"{one[-1]}{other[-1]}" for one, other in permutations(roster, 2) if severs(one, other)}


def both(*links: str) -> set[str]:
    return {link for each in links for link in (each, each[::-1])}


@pytest.mark.parametrize(
    ("partition", "robots", "links"),
    [
        (Partition(shape="halves"), 2, both("12")),
        (Partition(shape="halves"), 3, both("13", "23")),
        (Partition(shape="halves"), 4, both("13", "14", "23", "24")),
        (Partition(shape="ring"), 4, both("13", "24")),
        (Partition(shape="ring"), 5, both("13", "14", "24", "25", "35")),
        (Partition(shape="bridge"), 3, both("13")),
        (Partition(shape="bridge"), 4, both("14", "24")),
        (Partition(shape="bridge"), 5, both("14", "15", "24", "25")),
        (Partition(shape="isolate", robots=("r2",)), 3, both("12", "23")),
        (Partition(shape="isolate", robots=("r1", "r2")), 3, both("12", "13", "23")),
        (Partition(shape="groups", groups=(("r1", "r3"),)), 4, both("12", "14", "32", "34")),
        (Partition(shape="groups", groups=(("r1",), ("r2",))), 3, both("12", "13", "23")),
        (OneWay(senders=("r1",)), 3, {"12", "13"}),
        (OneWay(receivers=("r1",)), 3, {"21", "31"}),
        (OneWay(senders=("r1", "r2"), receivers=("r2", "r3")), 3, {"12", "13", "23"}),
    ],
)
def test_shapes_cut_their_links(
    partition: Partition | OneWay, robots: int, links: set[str]
) -> None:
    assert cut(partition, robots) == links


def test_supervisor_is_the_last_of_the_roster() -> None:
    halves = Partition(shape="halves")

    assert cut(halves, 3, centralized=True) == both("13", "1r", "23", "2r")


# Files of faults.


def chaos(folder: Path, text: str, scenario: Scenario | None = None) -> Scenario:
    path = folder / "storm.toml"
    path.write_text(text)
    return with_chaos(scenario or mission(), path)


def test_a_file_adds_its_faults_behind(tmp_path: Path) -> None:
    own = mission(fault(kind="drop", probability=0.5))
    storm = chaos(tmp_path, EVERY_KIND, own)

    assert storm.faults == (*own.faults, *parse(SMALL + EVERY_KIND, "small").faults)
    assert parse(to_toml(storm), "written") == storm


def test_a_file_cannot_kill_who_is_dead_already(tmp_path: Path) -> None:
    """By the scenario's own faults, which are in order."""
    own = mission(fault(kind="kill", who=["r1"], from_s=1, until_s=3))
    with pytest.raises(ScenarioError) as caught:
        chaos(tmp_path, "[[faults]]\nkind='kill'\nwho=['r2', 'r1']\nfrom_s=2\nuntil_s=4", own)

    assert str(caught.value) == (
        f"{tmp_path / 'storm.toml'}: faults[0].who: r1 has a kill then already, "
        f"by the scenario's faults[0]; move one of the two"
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "faults: missing; set it"),
        ("faults = []", "faults: expected `array` of length >= 1"),
        ("[radio]\ndrop = 0.5", "radio: no such key; known: faults"),
        ("[[fault]]\nkind='drop'", "fault: no such key; did you mean faults?"),
        ("[[faults]]\nkind='dorp'", "faults[0].kind: 'dorp' is not known; known: bandwidth"),
        ("[[faults]]\nkind='drop'\nprobabilty=1", "faults[0].probabilty: no such key; did you"),
        ("[[faults]]\nkind='partition'\nshape='x'", "faults[0].shape: 'x' is not known; known: ha"),
        ("[[faults]]\nkind='drop'\nprobability=1\nrobots=['r7']", "faults[0].robots: r7 is not"),
        ("[[faults]]\nkind='bandwidth'\nbytes_per_s=inf", "faults[0].bytes_per_s: inf is no usab"),
        ("[[faults", "not valid TOML: "),
    ],
)
def test_a_file_is_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    """Its own entries are counted, whatever faults the scenario has."""
    own = mission(fault(kind="drop", probability=0.5))
    with pytest.raises(ScenarioError) as caught:
        chaos(tmp_path, text, own)

    assert str(caught.value).startswith(f"{tmp_path / 'storm.toml'}: {says}")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.toml", tmp_path):
        with pytest.raises(ScenarioError, match=str(path)):
            with_chaos(mission(), path)
    (tmp_path / "noise.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="not valid TOML"):
        with_chaos(mission(), tmp_path / "noise.toml")


# Whatever is written.


def survives(tree: Any) -> None:
    scenario, said = None, ""
    try:
        scenario = from_tree(tree, "any")
    except ScenarioError as error:
        said = str(error)
    if scenario is None:
        assert len(said.splitlines()) == 1
    else:
        assert parse(to_toml(scenario), "written") == scenario


TREE = to_tree(parse(SMALL + EVERY_KIND, "small"))
PLACES = [("faults", *path) for path in paths_of(TREE["faults"])]


@examples(300)
@given(path=st.sampled_from(PLACES), value=TOML_VALUES)
def test_any_value_in_any_place_is_refused_or_a_scenario(
    path: tuple[str | int, ...], value: Any
) -> None:
    survives(planted(TREE, path, value))


@examples(100)
@given(i=st.integers(0, len(TREE["faults"]) - 1), key=TOML_KEYS, value=TOML_VALUES)
def test_any_key_in_any_fault_is_refused_or_a_scenario(i: int, key: str, value: Any) -> None:
    survives(planted(TREE, ("faults", i), {**TREE["faults"][i], key: value}))
