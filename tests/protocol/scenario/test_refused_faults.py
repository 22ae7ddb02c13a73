"""A fault that cannot apply is refused in one line."""

import pytest

from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import from_tree, parse
from support.faults.fault_tables import EVERY_KIND, fault
from support.grounds import exploration
from support.strategies import SMALL, mission


def refusal(text: str, *overrides: str) -> str:
    """The refusal of a scenario with such faults: one line that begins with the place."""
    with pytest.raises(ScenarioError) as caught:
        parse(SMALL + text, "small", overrides)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message.removeprefix("small: ")


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
    "probability of 0": (
        {"kind": "drop", "probability": 0.0},
        "faults[0].probability: expected `float` >",
    ),
    "before the start": (
        {"kind": "drop", "probability": 1, "from_s": -1},
        "faults[0].from_s: expected",
    ),
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
    "isolate without robots": (
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
    "unusable bandwidth": (
        {"kind": "bandwidth", "bytes_per_s": 1e-9},
        "faults[0].bytes_per_s: 1e-09 is",
    ),
    "no range": ({"kind": "range"}, "faults[0].range_m: set either range_m or factor"),
    "two ranges": (
        {"kind": "range", "range_m": 1.0, "factor": 0.5},
        "faults[0].range_m: set either range_m or factor",
    ),
    "hostile that never comes": (
        {"kind": "hostile", "probability": 0.0},
        "faults[0].probability: expected `float` > 0.0",
    ),
    "kill without who": ({"kind": "kill"}, "faults[0].who: missing; set it"),
    "kill of an empty list": (
        {"kind": "kill", "who": []},
        "faults[0].who: expected `array` of length >=",
    ),
    "kill of an unknown participant": (
        {"kind": "kill", "who": ["r1", "r9"]},
        "faults[0].who: r9 is not in the team; known: r1 to r3",
    ),
    "kill of an absent supervisor": (
        {"kind": "kill", "who": ["supervisor"]},
        "faults[0].who: supervisor is not in the team; known: r1 to r3",
    ),
    "kill that names a robot twice": (
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
    "kill of world-sim without an end": (
        {"kind": "kill", "who": ["worldsim"], "from_s": 1},
        "faults[0].until_s: missing; a mission cannot end without world-sim",
    ),
    "world-sim that loses its disk": (
        {"kind": "kill", "who": ["worldsim"], "until_s": 1, "disk": "lost"},
        "faults[0].disk: only for participants; leave it out for worldsim",
    ),
    "world-sim killed in a step": (
        {"kind": "kill", "who": ["worldsim"], "until_s": 1, "mid_step": True},
        "faults[0].mid_step: only for participants; leave it out for worldsim",
    ),
    "endless pause": (
        {"kind": "pause", "who": ["r1"]},
        "faults[0].until_s: missing; a pause needs an end",
    ),
    "endless full disk": (
        {"kind": "full-disk", "who": ["r1"]},
        "faults[0].until_s: missing; a full-disk needs an end",
    ),
    "full disk of world-sim": (
        {"kind": "full-disk", "who": ["worldsim"], "until_s": 1},
        "faults[0].who: worldsim is not in the team; known: r1 to r3",
    ),
    "endless late": (
        {"kind": "late", "who": ["r1"]},
        "faults[0].until_s: missing; a late needs an end",
    ),
    "late in the middle": (
        {"kind": "late", "who": ["r1"], "from_s": 1, "until_s": 2},
        "faults[0].from_s: a late joiner is missing from the start; leave it out",
    ),
    "all late": (
        {"kind": "late", "who": ["r3", "r1", "r2"], "until_s": 2},
        "faults[0].who: no robot would be there at the start; leave one out",
    ),
    "slow without effect": (
        {"kind": "slow", "who": ["r1"], "every": 1},
        "faults[0].every: expected `int` >= 2",
    ),
    "slow without a rate": ({"kind": "slow", "who": ["r1"]}, "faults[0].every: missing; set it"),
    "clock without an error": (
        {"kind": "clock", "who": ["r1"], "rate_ppm": 0.4},
        "faults[0].offset_s: the clock is right; set it, or rate_ppm",
    ),
    "clock too far off": (
        {"kind": "clock", "who": ["r1"], "offset_s": 4000.0},
        "faults[0].offset_s: expected `float` <= 3600.0",
    ),
    "unknown lie": (
        {"kind": "byzantine", "who": ["r1"], "lie": "murder"},
        "faults[0].lie: 'murder' is not known; known: overstate, rewrite, fork, claim, teleport",
    ),
    "liar of another team": (
        {"kind": "byzantine", "who": ["r9"], "lie": "fork"},
        "faults[0].who: r9 is not in the team; known: r1 to r3",
    ),
    "impostor with an end": (
        {"kind": "impostor", "who": ["r1"], "from_s": 1, "until_s": 2},
        "faults[0].until_s: an impostor asks once, at from_s; leave it out",
    ),
    "impostor of world-sim": (
        {"kind": "impostor", "who": ["worldsim"]},
        "faults[0].who: worldsim is not in the team; known: r1 to r3",
    ),
    "factor of an infinite range": (
        {"kind": "range", "factor": 0.5},
        "faults[0].factor: radio.range_m is infinite and stays so; set range_m",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_apply_is_refused(name: str) -> None:
    """One line: which entry, which key, what to do about it."""
    values, message = REFUSED[name]
    tree = {**to_tree(mission()), "faults": [values]}
    with pytest.raises(ScenarioError) as caught:
        from_tree(tree, "small")

    assert str(caught.value).startswith(f"small: {message}")


def test_a_refusal_names_the_number_of_the_entry() -> None:
    text = EVERY_KIND + '[[faults]]\nkind = "drop"\nprobability = 1\nuntil_s = 0\n'

    place = EVERY_KIND.count("[[faults]]")
    assert refusal(text).startswith(f"faults[{place}].until_s: 0 s is not after from_s, 0 s")


def test_range_must_shrink() -> None:
    """The range that counts: the supervisor's in a centralized mission."""
    shrunk = fault(kind="range", range_m=50.0)

    assert refusal("", "radio.range_m=50", shrunk) == (
        "faults[0].range_m: radio.range_m is 50 m already; set a shorter one"
    )
    assert "supervisor.range_m is 9 m already" in refusal(
        "", "coordination=centralized", "supervisor.range_m=9", shrunk
    )
    assert mission("coordination=centralized", shrunk).faults


def test_a_range_fault_needs_a_place_of_the_supervisor() -> None:
    """On a map the range of the supervisor counts from its place, which this one lacks."""
    with pytest.raises(ScenarioError, match="the supervisor has no place on the map"):
        exploration("coordination=centralized", fault(kind="range", range_m=5.0))


LIES_WITHOUT_EFFECT = {
    "overstate": (("merge=min", "claims=false"), "is about spending in a ledger"),
    "fork": (("merge=min", "claims=false"), "nobody compares logs of minima"),
    "claim": (("claims=false",), "nobody claims samples or shares registers"),
    "rewrite": (("merge=min", "claims=false"), "nobody passes on what others say"),
}


@pytest.mark.parametrize("lie", LIES_WITHOUT_EFFECT)
def test_a_lie_that_nobody_could_hear_is_refused(lie: str) -> None:
    overrides, why = LIES_WITHOUT_EFFECT[lie]

    refused = refusal("", *overrides, fault(kind="byzantine", who=["r1"], lie=lie))
    assert refused.startswith("faults[0].lie: ")
    assert why in refused


def test_a_map_has_no_spending_to_overstate() -> None:
    with pytest.raises(ScenarioError, match="overstate is about spending"):
        exploration(fault(kind="byzantine", who=["r1"], lie="overstate"))


def test_a_supervisor_does_not_lie() -> None:
    """It is believed without proof."""
    liar = fault(kind="byzantine", who=["supervisor"], lie="silence")

    assert refusal("", "coordination=centralized", liar).startswith(
        "faults[0].who: a supervisor is"
    )
