"""The scenario of a seed: a mission, its team, its radio, and its faults.

Swarm-style (Groce et al., "Swarm testing", ISSTA 2012): every class of faults is in or out by a coin whose
bias is drawn anew for each seed, so that some missions have one fault and some have all of them at once.

A mission has two phases. Up to a moment that is drawn any fault may strike (safety); after it none does, but
lost robots stay lost, and the team has to come to its end (liveness).
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import msgspec

from kantor_fleet.campaign.keyed_draws import KeyedDraws, short
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM, ParticipantId
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.liars import LIES, liars_of
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.faults.schedule import KINDS
from kantor_protocol.scenario.load import from_tree
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.scenario.validate_faults import complaints_of_faults
from kantor_worldsim.observers.checkers.liveness import settling_ns

Tree = dict[str, Any]

SORTS = {
    "claims": 0.36,
    "ledger": 0.15,
    "min": 0.17,
    "spectral": 0.14,
    "walking": 0.12,
    "map": 0.06,
}
"""Sorts of missions and how often each is drawn: a transport ledger with claims and without, the minimum,
multiscale coverage, samples that walk, an unknown map."""

_MISSION, _TEAM, _RADIO, _CLOCK, _FAULTS, _PUBLISH, _LINGER, _TRUST = range(8)
_A_CLASS = 16
"""Subjects of draws; from the last one on, one for each class of faults."""

_CENTRALIZED = 0.28
_SIGNED = 0.45
"""So many missions are signed."""
_LYING = 0.5
"""Of these so many have liars."""
_LINGER_PERIODS = 150
_METRICS_EVERY = 20
"""The rows are not read."""
_TRIES = 6
"""So often faults that exclude each other are drawn again."""
_LOST_SHARE = 0.5
"""Of the robots, at most, may be lost for good."""
_LIARS_SHARE = 0.5
"""Of the robots, at most, may lie."""


def sort_of(scenario: Scenario) -> str:
    """The sort of a mission, as it is counted."""
    if scenario.mapping:
        return "map"
    if scenario.planner.name == "spectral":
        return "spectral"
    if scenario.samples.diffusion_m > 0.0:
        return "walking"
    if scenario.merge == "min":
        return "min"
    return "claims" if scenario.claims else "ledger"


def draw(seed: int) -> Scenario:
    """The scenario of a seed; the mission is then run with the same seed."""
    sort = KeyedDraws(seed, _MISSION).one_of(list(SORTS), list(SORTS.values()))
    tree = _map(seed) if sort == "map" else _density(seed, sort)
    calm_s = tree.pop("calm_s")
    tree |= {
        "name": f"campaign-{seed}",
        "summary": f"Seed {seed} of a campaign: {sort}, faults up to t = {calm_s:g} s",
        "radio": _radio(seed, tree),
        "publish": _publish(seed),
        "metrics": {"every": _METRICS_EVERY},
    }
    if KeyedDraws(seed, _TRUST).coin(_SIGNED):
        tree["trust"] = "signed"
    scenario = _lingering(seed, from_tree(tree, f"seed {seed}"))
    faults = tuple(_faults(seed, scenario, calm_s))
    # Once more through the parser: what a campaign runs is what a user can write.
    return from_tree(to_tree(msgspec.structs.replace(scenario, faults=faults)), f"seed {seed}")


def _lingering(seed: int, scenario: Scenario) -> Scenario:
    """Half of the missions, where it takes no long time, go on until entries could be everywhere."""
    linger_ns = settling_ns(scenario, len(scenario.roster)) + 2 * scenario.period_ns
    if linger_ns > _LINGER_PERIODS * scenario.period_ns or not KeyedDraws(seed, _LINGER).coin():
        return scenario
    linger_s, limit_s = short(1.01e-9 * linger_ns), scenario.limit_s or 0.0
    return msgspec.structs.replace(scenario, linger_s=linger_s, limit_s=limit_s + 2.0 * linger_s)


def _density(seed: int, sort: str) -> Tree:
    draws = KeyedDraws(seed, _TEAM)
    robots = draws.whole(2, 8)
    points = robots * max(30, round(draws.scale(300, 6000) / robots))
    period_s = draws.scale(0.25, 2.5)
    steps = points // robots
    if draws.coin(0.4):
        steps = round(steps * draws.between(1.0, 1.6))
    clock = _clock(seed, period_s)
    side_m = draws.between(100.0, 500.0)
    fastest_s = period_s * (1.0 - clock["spread"])
    calm_s = short(draws.between(0.3, 0.8) * (points // robots) * fastest_s)
    stride_m = side_m * draws.scale(0.008, 0.08)
    return {
        "calm_s": calm_s,
        "coordination": "centralized" if draws.coin(_CENTRALIZED) else "decentralized",
        "merge": "min" if sort == "min" or (sort == "spectral" and draws.coin(0.3)) else "ledger",
        "claims": sort in {"claims", "walking"},
        "limit_s": short(calm_s + 2.0 * (steps + 100) * period_s * (1.0 + clock["spread"])),
        "domain": {"min_m": [0.0, 0.0], "max_m": [side_m, draws.between(100.0, 500.0)]},
        "robots": {"count": robots},
        "starts": {"random": True},
        "vehicle": _vehicle(draws, stride_m, period_s),
        "clock": clock,
        "energy": {"points": points, "steps": steps},
        "density": [_gaussian(draws, side_m) for _ in range(draws.whole(1, 3))],
        "samples": {
            "count": round(draws.scale(16, 400)),
            "diffusion_m": short(draws.scale(0.01, 0.5) * stride_m) if sort == "walking" else 0.0,
        },
        "targets": {
            "count": draws.whole(0, 40),
            "diffusion_m": draws.scale(0.01, 1.0) if draws.coin(0.3) else 0.0,
        },
        "sensor": {"range_m": short(side_m * draws.scale(0.01, 0.2))},
        "planner": {
            "name": "spectral" if sort == "spectral" else "transport",
            "horizon": draws.whole(1, 5),
            "modes": draws.whole(2, 8),
        },
        "reach_m": side_m,
    }


def _map(seed: int) -> Tree:
    draws = KeyedDraws(seed, _TEAM)
    period_s = draws.scale(0.3, 1.0)
    layout, side_m, resolution_m = draws.one_of(
        [("blank", 14.0, 1.0), ("office", 12.0, 0.25), ("unstructured", 24.0, 1.0)]
    )
    tree: Tree = {
        "calm_s": short(draws.between(8.0, 30.0) * period_s),
        "coordination": "centralized" if draws.coin(_CENTRALIZED) else "decentralized",
        "limit_s": 1500.0,
        "map": {
            "layout": layout,
            "size_m": [side_m, draws.between(side_m, 1.3 * side_m)],
            "resolution_m": resolution_m,
            "seed": draws.whole(0, 1000),
        },
        "robots": {"count": draws.whole(2, 4)},
        "starts": {"random": True, "spread": draws.one_of(["separate", "together"])},
        "vehicle": {
            "name": draws.one_of(["first-order", "second-order", "unicycle"], [4, 1, 1]),
            "speed_m_s": short(draws.between(0.6, 1.2) * min(1.0, 2.0 * resolution_m) / period_s),
        },
        "clock": _clock(seed, period_s),
        "sensor": {"range_m": draws.between(3.0, 6.0), "beams": draws.whole(16, 64)},
        "planner": {
            "name": draws.one_of(["frontier", "burgard", "market", "kmeans", "hungarian"]),
            "coverage": draws.one_of(["histogram", "linear", "disc"]),
            "patience": draws.whole(20, 60),
        },
        "reach_m": side_m,
    }
    noise = draws.between(0.05, 0.6) if draws.coin(0.3) else 0.0
    tree["sensor"]["noise_m"] = short(noise * resolution_m)
    return tree


def _vehicle(draws: KeyedDraws, stride_m: float, period_s: float) -> Tree:
    speed_m_s = short(stride_m / period_s)
    return {
        "name": draws.one_of(["first-order", "second-order", "unicycle", "dubins"], [6, 1, 1, 1]),
        "speed_m_s": speed_m_s,
        "acceleration_m_s2": short(speed_m_s / period_s * draws.scale(0.3, 3.0)),
        "turn_rate_rad_s": short(draws.scale(0.3, 3.0) / period_s),
        "turn_radius_m": short(stride_m * draws.scale(0.3, 3.0)),
    }


def _gaussian(draws: KeyedDraws, side_m: float) -> Tree:
    spread_m = side_m * draws.between(0.05, 0.3)
    return {
        "mean_m": [draws.between(0.1 * side_m, 0.9 * side_m) for _ in "xy"],
        "variance_m2": [short(spread_m**2), short(spread_m**2 * draws.between(0.3, 1.0))],
        "weight": draws.between(0.2, 1.0),
    }


def _clock(seed: int, period_s: float) -> Tree:
    """Most teams step all at once; the others show what clocks do to them."""
    draws = KeyedDraws(seed, _CLOCK)
    if draws.coin(0.7):
        return {"period_s": period_s, "spread": 0.0}
    spread = draws.between(0.0, 0.4) if draws.coin(0.4) else 0.0
    drift_ppm = draws.scale(1.0, 50_000.0) if draws.coin(0.4) else 0.0
    jitter = draws.between(0.0, 0.8) if draws.coin(0.4) else 0.0
    return {
        "period_s": period_s,
        "order": draws.one_of(["concurrent", "turn"]),
        "spread": spread,
        "drift_ppm": drift_ppm,
        "jitter_s": short(jitter * period_s * (1.0 - spread) * 0.9),
    }


def _publish(seed: int) -> Tree:
    draws = KeyedDraws(seed, _PUBLISH)
    return {"weights_every": draws.whole(1, 20), "keyframe_every": draws.whole(1, 30)}


def _radio(seed: int, tree: Tree) -> Tree:
    """Ranges that reach from no robot to all; imperfections that stay when the faults are over."""
    draws = KeyedDraws(seed, _RADIO)
    reach_m, period_s = tree.pop("reach_m"), tree["clock"]["period_s"]
    if tree["coordination"] == "centralized" and draws.coin(0.6):
        middle = 0.5 * reach_m
        placed = {"pose_m": [middle, middle], "range_m": short(reach_m * draws.scale(0.3, 1.5))}
        tree["supervisor"] = placed if "map" not in tree or draws.coin(0.5) else {}
    radio: Tree = {"beacon": draws.one_of(["versions", "state"], [2, 1])}
    if draws.coin(0.8):
        radio["range_m"] = short(reach_m * draws.scale(0.1, 1.5))
    if draws.coin(0.3):
        radio["drop"] = draws.between(0.0, 0.4)
    if draws.coin(0.4):
        radio["delay_s"] = short(draws.scale(0.1, 4.0) * period_s)
    if draws.coin(0.4):
        radio["jitter_s"] = short(draws.scale(0.1, 4.0) * period_s)
    if draws.coin(0.2):
        radio["duplicate"] = draws.between(0.0, 0.5)
    if draws.coin(0.2):
        radio |= {"reorder": draws.between(0.0, 0.5), "reorder_s": short(3.0 * period_s)}
    if "map" in tree and draws.coin(0.4):
        radio |= {"line_of_sight": draws.coin(), "wall_loss_m": draws.between(0.0, 3.0)}
    return radio


class FaultedMission(NamedTuple):
    """The mission for which faults are drawn."""

    scenario: Scenario
    calm_s: float
    """All faults are over then."""
    draws: KeyedDraws

    @property
    def roster(self) -> tuple[ParticipantId, ...]:
        """All participants."""
        return self.scenario.roster

    @property
    def period_s(self) -> float:
        """Nominal."""
        return self.scenario.clock.period_s

    def window(self, longest_s: float) -> Tree:
        """From somewhere in the first phase for at most so long."""
        draws, calm_s = self.draws, self.calm_s
        length_s = min(draws.scale(self.period_s, max(longest_s, 2.0 * self.period_s)), calm_s)
        from_s = 0.0 if draws.coin(0.1) else draws.unit() * (calm_s - length_s)
        return {"from_s": short(from_s), "until_s": short(min(from_s + length_s, calm_s))}

    def links(self) -> Tree:
        """All links, or those of some participants."""
        return {"robots": self.draws.some_of(self.roster)} if self.draws.coin(0.4) else {}

    def who(self, *others: ParticipantId) -> Tree:
        """One participant more often than not, of the roster or of the others."""
        others = others if self.draws.coin(0.2) else ()
        if SUPERVISOR in self.roster and self.draws.coin(0.25):
            return {"who": [SUPERVISOR]}
        return {"who": list(others) or self.draws.some_of(self.roster)}


def _partition(at: FaultedMission) -> Tree:
    draws = at.draws
    shape = draws.one_of(["halves", "ring", "bridge", "isolate", "groups"])
    tree: Tree = {"shape": shape, **at.window(0.8 * at.calm_s)}
    if shape == "isolate":
        tree["robots"] = draws.some_of(at.roster)
    if shape == "groups":
        sides = [draws.whole(0, 2) for _ in at.roster]
        groups = [
            [name for name, side in zip(at.roster, sides, strict=True) if side == i] for i in (1, 2)
        ]
        tree["groups"] = [group for group in groups if group]
    if draws.coin(0.35):
        tree |= {"flap_s": draws.scale(at.period_s, 10.0 * at.period_s)}
        tree |= {"flap_share": draws.between(0.1, 0.9)} if draws.coin() else {}
    return tree


def _one_way(at: FaultedMission) -> Tree:
    ends = at.draws.one_of([("senders",), ("receivers",), ("senders", "receivers")])
    return at.window(at.calm_s) | {end: at.draws.some_of(at.roster) for end in ends}


def _burst(at: FaultedMission) -> Tree:
    return {
        "good_s": at.draws.scale(at.period_s, 30.0 * at.period_s),
        "bad_s": at.draws.scale(at.period_s, 30.0 * at.period_s),
        "drop_good": at.draws.between(0.0, 0.2),
        "drop_bad": at.draws.between(0.5, 1.0),
    }


def _bandwidth(at: FaultedMission) -> Tree:
    tree: Tree = {"bytes_per_s": short(at.draws.scale(10.0, 1000.0) / at.period_s)}
    return tree | ({"queue_bytes": round(at.draws.scale(10, 3000))} if at.draws.coin() else {})


def _range(at: FaultedMission) -> Tree:
    scenario = at.scenario
    reach_m = scenario.supervisor.range_m if scenario.centralized else scenario.radio.range_m
    if reach_m < 1e9 and at.draws.coin():
        return {"factor": at.draws.between(0.0, 0.9)}
    return {"range_m": short(min(reach_m, 200.0) * at.draws.between(0.0, 0.9))}


def _kill(at: FaultedMission) -> Tree:
    draws = at.draws
    who = at.who(WORLD_SIM)
    tree = at.window(0.3 * at.calm_s) | who
    if WORLD_SIM in who["who"]:
        return tree
    if draws.coin(0.1) and SUPERVISOR not in who["who"]:
        return {"from_s": tree["from_s"], "who": who["who"][:1], "mid_step": draws.coin()}
    disk = draws.one_of(["kept", "torn", "lost"], [2, 1, 1])
    return tree | {"disk": disk, "mid_step": draws.coin(0.4)}


def _late(at: FaultedMission) -> Tree:
    return {"until_s": short(at.draws.between(0.05, 0.8) * at.calm_s), **at.who()}


def _clock_fault(at: FaultedMission) -> Tree:
    draws = at.draws
    tree = at.window(at.calm_s) | at.who()
    sign = draws.one_of([-1.0, 1.0])
    if draws.coin(0.8):
        tree["offset_s"] = sign * draws.scale(0.01, 3600.0)
    if draws.coin(0.5) or "offset_s" not in tree:
        tree["rate_ppm"] = float(round(sign * draws.scale(10.0, 50_000.0)))
    return tree


def _byzantine(at: FaultedMission) -> Tree:
    return {"who": at.draws.some_of(at.scenario.robot_ids), "lie": at.draws.one_of(LIES)}


_DRAWN: dict[str, Callable[[FaultedMission], Tree]] = {
    "drop": lambda at: {"probability": at.draws.between(0.05, 0.6)} | at.links(),
    "burst": lambda at: _burst(at) | at.links(),
    "delay": lambda at: {
        "delay_s": at.draws.scale(0.05, 10.0),
        "jitter_s": at.draws.scale(0.05, 10.0) if at.draws.coin() else 0.0,
        **at.links(),
    },
    "duplicate": lambda at: {
        "probability": at.draws.between(0.05, 0.5),
        "copies": at.draws.whole(1, 3),
        "delay_s": at.draws.scale(0.01, 10.0),
        **at.links(),
    },
    "replay": lambda at: {
        "probability": at.draws.between(0.02, 0.5),
        "age_s": at.draws.scale(at.period_s, at.calm_s + at.period_s),
        **at.links(),
    },
    "reorder": lambda at: {
        "probability": at.draws.between(0.05, 0.6),
        "hold_s": at.draws.scale(at.period_s, 10.0 * at.period_s),
        **at.links(),
    },
    "one-way": _one_way,
    "partition": _partition,
    "clog": lambda at: at.window(30.0) | at.links(),
    "bandwidth": _bandwidth,
    "range": lambda at: _range(at) | at.links(),
    "hostile": lambda at: {"probability": at.draws.between(0.01, 0.2)} | at.links(),
    "kill": _kill,
    "pause": lambda at: at.window(60.0) | at.who(WORLD_SIM),
    "late": _late,
    "slow": lambda at: {"every": at.draws.whole(2, 12)} | at.window(at.calm_s) | at.who(),
    "full-disk": lambda at: at.window(0.3 * at.calm_s) | at.who(),
    "clock": _clock_fault,
    "impostor": lambda at: {"from_s": short(at.draws.unit() * at.calm_s), **at.who()},
    "byzantine": _byzantine,
}
"""The fields drawn for each class. One that sets no window gets one."""

_MANY = {"kill": 6, "pause": 4, "partition": 3, "clock": 3, "byzantine": 3}
"""So often at most in one mission; any other class twice."""


def _faults(seed: int, scenario: Scenario, calm_s: float) -> Iterable[Fault]:
    """Each class is in or out; of what is in, as much as can be there together."""
    bias = KeyedDraws(seed, _FAULTS).between(0.05, 0.5)
    taken: list[Fault] = []
    for number, kind in enumerate(KINDS):
        if kind == "byzantine" and not scenario.signed:
            continue  # it would be believed
        at = FaultedMission(scenario, calm_s, KeyedDraws(seed, _A_CLASS + number))
        if not at.draws.coin(_LYING if kind == "byzantine" else bias):
            continue
        for _ in range(at.draws.whole(1, _MANY.get(kind, 2))):
            fault = next(candidates(at, kind, taken), None)
            taken += [] if fault is None else [fault]
    return taken


def candidates(at: FaultedMission, kind: str, taken: list[Fault]) -> Iterator[Fault]:
    """Faults of a class that can be there with the others."""
    for _ in range(_TRIES):
        tree = {"kind": kind, **_DRAWN[kind](at)}
        if "from_s" not in tree and "until_s" not in tree:
            tree |= at.window(at.calm_s)
        fault = msgspec.convert(tree, KINDS[kind])
        together = [*taken, fault]
        if (
            not _too_many_lost(at.scenario, together)
            and len(liars_of(together)) <= _LIARS_SHARE * at.scenario.robots.count
            and not any(complaints_of_faults([fault], at.scenario, taken))
        ):
            yield fault


def _too_many_lost(scenario: Scenario, faults: Iterable[Fault]) -> bool:
    lost = {
        name
        for fault in faults
        if isinstance(fault, Kill) and fault.until_s is None
        for name in fault.who
    }
    return len(lost) > _LOST_SHARE * scenario.robots.count
