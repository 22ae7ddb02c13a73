"""Burgard, Fox, Moors, Simmons, Thrun: "Collaborative Multi-Robot Exploration" (2000), figure 8.

The paper says neither how the random starts lie nor when robots choose new targets, and its claims depend
on both. Its figure is therefore drawn in four readings. Their numbers are those of an independent
simulator in an office of the same 27 x 20 m: the paper's own is not in its text.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from kantor_fleet.reproduce import explored
from kantor_fleet.reproduce.claims import Claim, IdenticalRuns, MeanRatio
from kantor_fleet.reproduce.figure import PaperFigure
from kantor_fleet.reproduce.measured_runs import Setting
from kantor_fleet.reproduce.measures import distance_m, finished, map_row

TEAMS = (1, 2, 3)
_RUNS = 20
"""The paper has ten; with ten, intervals are as wide as the effect."""
_SIGNIFICANT = 0.95
"""Coordinated over uncoordinated: "significantly less time"."""


class Reading(NamedTuple):
    """A choice of what the paper leaves open."""

    letter: str
    text: str
    spread: str
    """starts.spread."""
    coordinated: tuple[str, str]
    """planner.replan_on and planner.replan_whose of coordinated robots."""
    uncoordinated: tuple[str, str]
    gains: tuple[str, str]
    """Ratios of mean times, coordinated over uncoordinated, of two and of three robots."""
    across: str
    """The ratio of mean times, two coordinated robots over three uncoordinated ones."""
    across_low: float = -math.inf
    across_high: float = math.inf
    why: str = ""

    def setting(self, robots: int, *, coordinated: bool) -> Setting:
        """The office explored under this reading."""
        on, whose = self.coordinated if coordinated else self.uncoordinated
        overrides = (
            "coordination=centralized",
            "radio.range_m=inf",
            f"robots.count={robots}",
            f"starts.spread={self.spread}",
            f"planner.coordinated={str(coordinated).lower()}",
            f"planner.replan_on={on}",
            f"planner.replan_whose={whose}",
        )
        return Setting("office", overrides)


_APART = (
    "robots that start anywhere are apart without being coordinated, and a third robot then gains more "
    "than coordination does; side by side (B) the claim holds"
)
_EVENTS, _ARRIVALS, _OWN = ("events", "team"), ("arrivals", "team"), ("arrivals", "own")

READINGS = (
    Reading(
        "A",
        "starts anywhere, all choose anew on any event",
        "separate",
        _EVENTS,
        _EVENTS,
        ("0.94 [0.88, 0.98]", "0.91 [0.84, 0.99]"),
        "1.33 [1.24, 1.44]",
        1.1,
        1.6,
        _APART,
    ),
    Reading(
        "B",
        "starts side by side, all choose anew on any event",
        "together",
        _EVENTS,
        _EVENTS,
        ("0.86 [0.79, 0.93]", "0.69 [0.63, 0.77]"),
        "0.99 [0.90, 1.09]",
        0.85,
        1.15,
    ),
    Reading(
        "C",
        "starts anywhere; on arrivals: coordinated all, uncoordinated who arrives",
        "separate",
        _ARRIVALS,
        _OWN,
        ("0.82 [0.74, 0.90]", "0.67 [0.61, 0.73]"),
        "1.01 [0.93, 1.08]",
    ),
    Reading(
        "D",
        "starts side by side; coordinated on events, uncoordinated who arrives",
        "together",
        _EVENTS,
        _OWN,
        ("0.52", "0.49"),
        "0.70 [0.64, 0.79]",
    ),
)


def _claims(reading: Reading) -> Iterator[Claim]:
    def setting(robots: int, *, coordinated: bool) -> Setting:
        return reading.setting(robots, coordinated=coordinated)

    name = reading.letter
    alone, alone_uncoordinated = (setting(1, coordinated=how) for how in (True, False))
    if reading.coordinated[0] == reading.uncoordinated[0]:
        yield IdenticalRuns(
            f"{name}: 1 robot, coordinated and not",
            alone,
            alone_uncoordinated,
            "one bar",
            (finished, distance_m),
        )
    yield MeanRatio(
        f"{name}: uncoordinated, 2 robots over 1",
        setting(2, coordinated=False),
        alone_uncoordinated,
        "faster",
        "< 1",
        finished,
        high=1.0,
    )
    for robots, gain in zip((2, 3), reading.gains, strict=True):
        yield MeanRatio(
            f"{name}: {robots} robots, coordinated over uncoordinated",
            setting(robots, coordinated=True),
            setting(robots, coordinated=False),
            "significantly less",
            f"≤ {_SIGNIFICANT} ({gain})",
            finished,
            high=_SIGNIFICANT,
        )
    judged = math.isfinite(reading.across_low)
    band = f"{reading.across_low} to {reading.across_high} ({reading.across})"
    yield MeanRatio(
        f"{name}: 2 coordinated over 3 uncoordinated",
        setting(2, coordinated=True),
        setting(3, coordinated=False),
        "about the same",
        band if judged else reading.across,
        finished,
        reading.across_low,
        reading.across_high,
        reading.why,
    )


def _by_radio(range_m: int) -> Setting:
    """Three robots of reading A without a supervisor; robots that hear each other coordinate."""
    overrides = (
        "coordination=decentralized",
        f"radio.range_m={range_m}",
        "robots.count=3",
        "starts.spread=separate",
    )
    return Setting("office", overrides)


_SUPERVISED = READINGS[0].setting(3, coordinated=True)
_RADIO = (
    MeanRatio(
        "3 robots that hear each other within 12 m (36 % of the diagonal), over a supervisor's",
        _by_radio(12),
        _SUPERVISED,
        "",
        "≤ 1.1 (1.06 ± 0.09)",
        finished,
        high=1.1,
    ),
    MeanRatio(
        "3 robots that do not hear each other, over a supervisor's",
        _by_radio(0),
        _SUPERVISED,
        "",
        "3.00 ± 0.22",
        finished,
    ),
)

FIG_8 = PaperFigure(
    "time to explore an office, coordinated and not",
    _RUNS,
    (*(claim for reading in READINGS for claim in _claims(reading)), *_RADIO),
    lambda measured: explored.bars(
        READINGS[0].setting(1, coordinated=True).find(),
        {
            f"({reading.letter}) {reading.text}": {
                coordinated: {
                    robots: measured[reading.setting(robots, coordinated=coordinated)]
                    for robots in TEAMS
                }
                for coordinated in (False, True)
            }
            for reading in READINGS
        },
        finished,
    ),
    map_row,
    tuple(
        reading.setting(robots, coordinated=coordinated)
        for reading in READINGS
        for robots in TEAMS
        for coordinated in (False, True)
    ),
    kept=True,
)

FIGURES = {"burgard-fig8": FIG_8}
