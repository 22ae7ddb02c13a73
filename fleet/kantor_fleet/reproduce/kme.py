"""Puig, Garcia, Wu: exploration of regions by K-means (KME) compared with three other planners: figures 6 to 8.

KME is compared with Yamauchi's nearest frontier, Burgard et al.'s coordinated frontiers and Zlot et al.'s
market, by how evenly eight regions of a map are explored. Configurations are 3 maps x 2 kinds of starts x 2 to 8
robots x 15 spots. Neither the maps, nor the sensor, nor how Zlot's robots propose goals are in the paper;
readings are those of an independent simulator on maps of these kinds with goals by quadtree. All four
choose new targets whenever a robot arrives, and a way costs its length.
"""

import functools
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

from kantor_fleet.reproduce import explored
from kantor_fleet.reproduce.claims import (
    Claim,
    GeometricMeanRatio,
    Group,
    LowerThroughout,
    LowestMean,
    Measure,
    geometric,
    paired_ratios,
    text_of_ratio,
)
from kantor_fleet.reproduce.figure import PaperFigure, ResultTable, RunRequests
from kantor_fleet.reproduce.measured_runs import MeasuredRuns, Setting
from kantor_fleet.reproduce.measures import epv_mean, finished, map_row, wtv_final, wtv_mean
from kantor_fleet.sweep.table import Row

MAPS = ("blank", "unstructured", "cityblock")
STARTS = ("together", "separate")
TEAMS = tuple(range(2, 9))
SPOTS = 15
CONFIGURATIONS = len(MAPS) * len(STARTS) * len(TEAMS) * SPOTS

KME, YAMAUCHI, BURGARD, ZLOT = "KME", "Yamauchi", "Burgard", "Zlot"
_PLANNERS = {
    KME: ("planner.name=kmeans",),
    YAMAUCHI: ("planner.name=frontier",),
    BURGARD: ("planner.name=burgard",),
    ZLOT: ("planner.name=market", "planner.goals=quadtree"),
    "Zlot greedy": ("planner.name=market", "planner.goals=greedy"),
    "Zlot random": ("planner.name=market", "planner.goals=random"),
}
PLANNERS = (KME, YAMAUCHI, BURGARD, ZLOT)
OTHERS = PLANNERS[1:]
_EVERY_PLANNER = tuple(_PLANNERS)
_PLOTTED = (2, 4, 6, 8)
_MANY = tuple(team for team in TEAMS if team >= 4)
_BY_GOALS = (
    "whether KME lies below Zlot's market depends on how goals are proposed, which the paper leaves "
    "open; here by quadtree"
)


class Configuration(NamedTuple):
    """The conditions under which all planners are compared."""

    map: str
    starts: str
    robots: int
    spot: int
    """The seed too: for robots that start together it is the number of their spot."""


def setting(planner: str, place: str, starts: str, robots: int) -> Setting:
    """The exploration of a map by a planner."""
    overrides = (f"starts.spread={starts}", f"robots.count={robots}", *_PLANNERS[planner])
    return Setting(place, overrides)


@functools.cache
def configurations() -> tuple[Configuration, ...]:
    """All 630 configurations, in an order of which every beginning is balanced.

    `--runs n` takes the first n. Any 6 in a row have every map with every kind of starts, any
    7 every number of robots, any 42 all of these together; 42 later the same come with another spot.
    """
    return tuple(
        Configuration(
            MAPS[i % len(MAPS)],
            STARTS[i % len(STARTS)],
            TEAMS[-1 - i % len(TEAMS)],
            (i % 42 + i // 42) % SPOTS,
        )
        for i in range(CONFIGURATIONS)
    )


def requests(runs: int) -> RunRequests:
    """The first configurations, each with all four planners."""
    requested: dict[Setting, list[int]] = {}
    for place, starts, robots, spot in configurations()[:runs]:
        for planner in PLANNERS:
            requested.setdefault(setting(planner, place, starts, robots), []).append(spot)
    return {each: sorted(seeds) for each, seeds in requested.items()}


def group(planner: str, teams: tuple[int, ...] = _MANY, starts: tuple[str, ...] = STARTS) -> Group:
    """Settings of a planner over all maps, in the same order for every planner."""
    product = itertools.product(MAPS, starts, teams)
    return tuple(setting(planner, place, start, robots) for place, start, robots in product)


MEASURES: dict[str, Measure] = {
    "final WTV": wtv_final,
    "mean WTV": wtv_mean,
    "mean EPV": epv_mean,
    "completion": finished,
}
_READING = {
    # of 4 and of 8 robots, by the independent simulator
    ("final WTV", YAMAUCHI): "0.23, 0.25",
    ("final WTV", BURGARD): "0.40, 0.37",
    ("final WTV", ZLOT): "0.92, 0.63",
    ("mean WTV", YAMAUCHI): "0.25, 0.27",
    ("mean WTV", BURGARD): "0.42, 0.40",
    ("mean WTV", ZLOT): "0.81, 0.59",
    ("mean EPV", YAMAUCHI): "0.57, 0.60",
    ("mean EPV", BURGARD): "0.52, 0.54",
    ("mean EPV", ZLOT): "1.06, 0.96",
    ("completion", YAMAUCHI): "0.63, 0.61",
    ("completion", BURGARD): "0.93, 0.85",
    ("completion", ZLOT): "0.75, 0.67",
}
_MOST = {
    ("final WTV", YAMAUCHI): 0.45,
    ("final WTV", BURGARD): 0.65,
    ("mean EPV", YAMAUCHI): 0.75,
    ("mean EPV", BURGARD): 0.70,
}


def _over_all() -> Iterator[Claim]:
    for (name, measure), other in itertools.product(MEASURES.items(), OTHERS):
        most = _MOST.get((name, other), math.inf)
        reading = f"4, 8 robots: {_READING[name, other]}"
        yield GeometricMeanRatio(
            f"4 to 8 robots, {name}: KME over {other}",
            group(KME),
            group(other),
            "" if name == "completion" else "lowest",
            reading if math.isinf(most) else f"≤ {most} ({reading})",
            measure,
            most,
            _BY_GOALS if (name, other) == ("final WTV", ZLOT) else "",
        )
    yield LowerThroughout(
        "mean WTV, separate starts over together",
        tuple(
            (planner, group(planner, starts=("separate",)), group(planner, starts=("together",)))
            for planner in PLANNERS
        ),
        "lower, each",
        wtv_mean,
    )


def _lowest(
    starts: str, measure_name: str, robots: int, planners: tuple[str, ...] = PLANNERS
) -> LowestMean:
    return LowestMean(
        f"{robots} robots, {starts}: {measure_name}",
        tuple((name, setting(name, "unstructured", starts, robots)) for name in planners),
        "" if robots == 2 and "WTV" in measure_name else "KME lowest",
        MEASURES[measure_name],
        () if robots == 2 else (YAMAUCHI, BURGARD),
        _BY_GOALS,
    )


def _more_robots(starts: str) -> LowerThroughout:
    return LowerThroughout(
        f"{starts}: mean WTV, 8 robots over 2",
        tuple(
            (
                planner,
                (setting(planner, "unstructured", starts, 8),),
                (setting(planner, "unstructured", starts, 2),),
            )
            for planner in PLANNERS
        ),
        "lower, each",
        wtv_mean,
    )


def _curves(
    title: str, starts: str, curve: str, planners: tuple[str, ...], *claims: Claim
) -> PaperFigure:
    """A figure with a panel for every size of team and a line for every planner."""
    panels = {
        robots: {name: setting(name, "unstructured", starts, robots) for name in planners}
        for robots in _PLOTTED
    }
    return PaperFigure(
        title,
        SPOTS,
        claims,
        lambda measured: explored.curves(
            {
                robots: {name: measured[line] for name, line in panel.items()}
                for robots, panel in panels.items()
            },
            curve,
        ),
        map_row,
        tuple(line for panel in panels.values() for line in panel.values()),
        kept=True,
    )


def _wtv_claims(starts: str, planners: tuple[str, ...]) -> Iterator[Claim]:
    for name, robots in itertools.product(("mean WTV", "final WTV"), _PLOTTED):
        yield _lowest(starts, name, robots, planners)
    yield _more_robots(starts)


def _ratio_rows(measured: MeasuredRuns) -> Iterator[Row]:
    teams = {str(team): (team,) for team in TEAMS} | {"4 to 8": _MANY}
    for (name, measure), (text, team) in itertools.product(MEASURES.items(), teams.items()):
        for other in OTHERS:
            ratios = list(paired_ratios(measured, group(KME, team), group(other, team), measure))
            if ratios:
                mean, factor = geometric(ratios)
                yield {
                    "measure": name,
                    "against": other,
                    "robots": text,
                    "configurations": len(ratios),
                    "ratio": mean,
                    "factor_95": factor,
                    "kme_lowest": None,
                }
        lows = list(_kme_lowest(measured, team, measure))
        if lows:
            yield {
                "measure": name,
                "against": "all three",
                "robots": text,
                "configurations": len(lows),
                "ratio": None,
                "factor_95": None,
                "kme_lowest": sum(lows) / len(lows),
            }


def _kme_lowest(measured: MeasuredRuns, team: tuple[int, ...], measure: Measure) -> Iterator[bool]:
    """Whether KME is below all others, configuration by configuration."""
    for settings in zip(*(group(planner, team) for planner in PLANNERS), strict=True):
        for runs in zip(*(measured.get(one, ()) for one in settings), strict=True):
            kme, *others = map(measure, runs)
            yield kme < min(others)


def ratios(measured: MeasuredRuns) -> ResultTable:
    """The table of KME over the others, by number of robots."""
    rows = list(_ratio_rows(measured))
    columns = [*map(str, TEAMS), "4 to 8"]
    shown: dict[tuple[str, str], Row] = {}
    for row in rows:
        line = shown.setdefault(
            (row["measure"], row["against"]),
            {"measure": row["measure"], "KME over": row["against"]} | dict.fromkeys(columns, ""),
        )
        line[row["robots"]] = (
            f"{100.0 * row['kme_lowest']:.0f} %"
            if row["ratio"] is None
            else text_of_ratio(row["ratio"], row["factor_95"])
        )
        if row["ratio"] is None:
            line["KME over"] = "lowest of four"
    title = (
        f"KME over the others, geometric mean x÷ 95 % by number of robots; "
        f"{sum(len(runs) for runs in measured.values()) // len(PLANNERS)} of {CONFIGURATIONS} configurations"
    )
    return ResultTable(title, rows, list(shown.values()))


FIG_6 = _curves(
    "waiting time variance, robots start together",
    "together",
    "wtv",
    _EVERY_PLANNER,
    *_wtv_claims("together", _EVERY_PLANNER),
)
FIG_7 = _curves(
    "waiting time variance, robots start apart",
    "separate",
    "wtv",
    PLANNERS,
    *_wtv_claims("separate", PLANNERS),
)
FIG_8 = _curves(
    "variance of the explored share, robots start apart",
    "separate",
    "epv",
    PLANNERS,
    *(_lowest("separate", "mean EPV", robots) for robots in _PLOTTED),
)
ALL = PaperFigure(
    "all configurations",
    CONFIGURATIONS,
    tuple(_over_all()),
    lambda measured: explored.ratios(ratios(measured).rows, tuple(MEASURES), OTHERS, TEAMS),
    map_row,
    select=requests,
    table=ratios,
    kept=True,
)

FIGURES = {"kme-fig6": FIG_6, "kme-fig7": FIG_7, "kme-fig8": FIG_8, "kme-all": ALL}
