"""The scenario of a seed on real processes: a team with a supervisor, and a storm of signals.

Its times are drawn in real seconds, since what a process has to survive (a start, a lease) takes real time,
and converted to simulated ones for the scenario. The number of strikes of each kind is not left to chance: a
soak of a quarter of an hour must have seen enough of each.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from kantor_fleet.campaign.draw import FaultedMission, candidates
from kantor_fleet.campaign.keyed_draws import KeyedDraws, short
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM, ParticipantId
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.liars import LIES, Byzantine
from kantor_protocol.scenario.faults.processes import OnProcesses
from kantor_protocol.scenario.faults.schedule import KINDS
from kantor_protocol.scenario.load import from_tree
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.scenario.validate_faults import complaints_of_faults
from kantor_worldsim.observers.checkers.liveness import settling_ns

Tree = dict[str, Any]

STORM_S = 40.0
"""Real time in which faults may strike."""
SPEED = 8.0
"""Simulated seconds in a real one."""
LOCKSTEP_EVERY = 6
"""One mission in so many is run in lockstep, the others in real time."""
_LONGER = 5.0
"""In lockstep, where no clock has to be waited for, a storm is so many times as long."""

_ROBOT_KILLS, _SUPERVISOR_KILLS, _WORLD_SIM_KILLS = 10, 3, 1.4
_ROBOT_PAUSES, _SUPERVISOR_PAUSES, _WORLD_SIM_PAUSES = 9, 2, 0.6
"""In STORM_S, and in proportion."""
_PROBABILITIES = {"late": 0.5, "slow": 0.6, "full-disk": 0.6, "clock": 0.6, "impostor": 0.5}
"""That a mission has one, or two, of the others."""
_A_LINK = 0.5
"""That it has one, or two, of a class of faults of links."""
_LOST = 0.2
"""That a robot is lost for good in it."""

_CALM_START_S = 1.0
_APART_S = 1.5
"""From one fault of a process to its next, so that it is back from the first."""
_OUTAGE_MARGIN_S = 0.5
_IMPOSTOR_S = 3.0
"""While an impostor is refused, the participant that it impersonates must run."""
_TRIES = 60
_REST_S = 90.0
"""After the storm a mission has so long to come to its end."""
_SPENDING_SHARE = 0.8
"""Of the storm robots have energy for; one that was down has some left when it is over."""
_SUBJECT = 2000


def is_lockstep(seed: int) -> bool:
    """Whether the mission of a seed is run in lockstep."""
    return seed % LOCKSTEP_EVERY == LOCKSTEP_EVERY - 1


def process_scenario(
    seed: int, speed: float = SPEED, storm_s: float = STORM_S, *, byzantine: bool = False
) -> Scenario:
    """The scenario of a seed; the mission is then run with the same seed. storm_s: real seconds.

    byzantine: one robot lies for most of the storm, and everybody signs.
    """
    pace = speed * (_LONGER if is_lockstep(seed) else 1.0)
    scenario = _lingering(from_tree(_team(seed, speed, pace, storm_s), f"seed {seed}"), speed)
    timetable = _Timetable(KeyedDraws(seed, _SUBJECT + 1), scenario, pace, storm_s)
    faults: list[Fault] = list(timetable.draw())
    for number, kind in enumerate(KINDS):
        if not issubclass(KINDS[kind], (OnProcesses, Byzantine)):
            at = FaultedMission(scenario, pace * storm_s, KeyedDraws(seed, _SUBJECT + 10 + number))
            faults += _of_links(at, kind)
    if byzantine:
        scenario = msgspec.structs.replace(scenario, trust="signed")
        faults.append(
            _liar(FaultedMission(scenario, pace * storm_s, KeyedDraws(seed, _SUBJECT + 2)))
        )
    # Once more through the parser: what a campaign runs is what a user can write.
    whole = msgspec.structs.replace(scenario, faults=tuple(faults))
    return from_tree(to_tree(whole), f"seed {seed}")


def _team(seed: int, speed: float, pace: float, storm_s: float) -> Tree:
    draws = KeyedDraws(seed, _SUBJECT)
    robots, merge = draws.whole(4, 6), draws.one_of(["ledger", "min"])
    period_s = short(speed * draws.between(0.09, 0.14))
    steps = max(20, round(_SPENDING_SHARE * pace * storm_s / period_s))
    side_m = draws.between(100.0, 400.0)
    spread = draws.between(0.0, 0.2) if draws.coin() else 0.0
    return {
        "name": f"storm-{seed}",
        "summary": f"Seed {seed} of a campaign on processes: {merge}, {robots} robots",
        "coordination": "centralized",
        "merge": merge,
        "claims": merge == "ledger" and draws.coin(),
        "limit_s": short(pace * (storm_s + _REST_S)),
        "domain": {"min_m": [0.0, 0.0], "max_m": [side_m, side_m]},
        "robots": {"count": robots},
        "starts": {"random": True},
        "vehicle": {"speed_m_s": short(side_m * draws.scale(0.01, 0.06) / period_s)},
        "clock": {
            "period_s": period_s,
            "spread": spread,
            "drift_ppm": draws.scale(1.0, 10_000.0) if draws.coin() else 0.0,
            "jitter_s": short(0.2 * draws.unit() * period_s) if draws.coin() else 0.0,
        },
        "energy": {"points": robots * steps, "steps": steps},
        "density": [
            {
                "mean_m": [draws.between(0.2 * side_m, 0.8 * side_m) for _ in "xy"],
                "variance_m2": [short((0.2 * side_m) ** 2)] * 2,
            }
        ],
        "samples": {"count": draws.whole(50, 300)},
        "targets": {"count": draws.whole(0, 20)},
        "sensor": {"range_m": short(0.05 * side_m)},
        "radio": {
            "range_m": short(side_m * draws.scale(0.3, 1.5)),
            "delay_s": short(draws.unit() * period_s) if draws.coin() else 0.0,
        },
        "metrics": {"every": 20},
    }


def _lingering(scenario: Scenario, speed: float) -> Scenario:
    """The mission goes on until entries could be everywhere, and for a real second more."""
    linger_s = 1e-9 * settling_ns(scenario, len(scenario.roster)) + speed
    return msgspec.structs.replace(scenario, linger_s=short(linger_s))


def _of_links(at: FaultedMission, kind: str) -> Iterator[Fault]:
    if at.draws.coin(_A_LINK):
        for _ in range(at.draws.whole(1, 2)):
            yield from (fault for fault in [next(candidates(at, kind, []), None)] if fault)


def _liar(at: FaultedMission) -> Byzantine:
    """A robot with a lie that this mission can have, from near the start to near the end of the storm."""
    name = at.draws.one_of(at.scenario.robot_ids)
    window = {
        "from_s": short(at.draws.between(0.0, 0.2) * at.calm_s),
        "until_s": short(at.draws.between(0.7, 1.0) * at.calm_s),
    }
    told = [
        msgspec.convert({"kind": "byzantine", "who": [name], "lie": lie, **window}, Byzantine)
        for lie in LIES
    ]
    return at.draws.one_of(
        [each for each in told if not any(complaints_of_faults([each], at.scenario))]
    )


class _Timetable:
    """The times at which faults strike processes, in real seconds since the start."""

    def __init__(self, draws: KeyedDraws, scenario: Scenario, pace: float, storm_s: float) -> None:
        self._draws, self._scenario = draws, scenario
        self._pace, self._storm_s = pace, storm_s
        names = (*scenario.roster, WORLD_SIM)
        self._taken: dict[ParticipantId, list[tuple[float, float]]] = {name: [] for name in names}
        self._faults: list[Fault] = []

    def draw(self) -> list[Fault]:
        """All faults of processes, those with the least room first."""
        draws, robots = self._draws, self._scenario.robot_ids
        self._repeat(_WORLD_SIM_KILLS, lambda: self._kill(WORLD_SIM))
        self._repeat(_WORLD_SIM_PAUSES, lambda: self._pause(WORLD_SIM))
        if draws.coin(_PROBABILITIES["late"]):
            self._late(draws.one_of(robots))
        for _ in range(self._some("impostor")):
            self._strike("impostor", draws.one_of(self._scenario.roster), None, _IMPOSTOR_S)
        if draws.coin(_LOST):
            self._lose(draws.one_of(robots))
        self._repeat(_SUPERVISOR_KILLS, lambda: self._kill(SUPERVISOR))
        self._repeat(_ROBOT_KILLS, lambda: self._kill(draws.one_of(robots)))
        self._repeat(_SUPERVISOR_PAUSES, lambda: self._pause(SUPERVISOR))
        self._repeat(_ROBOT_PAUSES, lambda: self._pause(draws.one_of(robots)))
        for _ in range(self._some("slow")):
            name, every = draws.one_of(self._scenario.roster), draws.whole(2, 5)
            self._strike("slow", name, draws.between(1.0, 4.0), every=every)
        for _ in range(self._some("full-disk")):
            name = draws.one_of(self._scenario.roster)
            self._strike("full-disk", name, draws.between(0.5, 3.0))
        for _ in range(self._some("clock")):
            self._clock(draws.one_of(self._scenario.roster))
        return self._faults

    def _repeat(self, in_storm: float, strike: Callable[[], bool]) -> None:
        """Strike so often, in proportion to the storm; a fraction is the probability of one more."""
        wanted = in_storm * self._storm_s / STORM_S
        times = max(1, math.floor(wanted + self._draws.unit())) if in_storm >= 1.0 else 0
        times = times or int(self._draws.coin(min(1.0, wanted)))
        for _ in range(times):
            for _ in range(_TRIES):
                if strike():
                    break

    def _some(self, kind: str) -> int:
        return self._draws.whole(1, 2) if self._draws.coin(_PROBABILITIES[kind]) else 0

    def _kill(self, name: ParticipantId) -> bool:
        draws, length_s = self._draws, self._draws.between(0.3, 2.0)
        if name == WORLD_SIM:
            return self._strike("kill", name, length_s)
        disk = draws.one_of(["kept", "torn", "lost"], [2, 1, 1])
        return self._strike("kill", name, length_s, disk=disk, mid_step=draws.coin(0.3))

    def _pause(self, name: ParticipantId) -> bool:
        """Some for longer than a lease."""
        return self._strike("pause", name, self._draws.between(0.2, 2.2))

    def _clock(self, name: ParticipantId) -> None:
        sign, jumps = self._draws.one_of([-1.0, 1.0]), self._draws.coin()
        wrong: Tree = {"offset_s": sign * self._draws.scale(0.01, 3600.0)}
        if not jumps:
            wrong = {"rate_ppm": float(round(sign * self._draws.scale(10.0, 50_000.0)))}
        self._strike("clock", name, self._draws.between(1.0, 10.0), stops=False, **wrong)

    def _late(self, name: ParticipantId) -> None:
        until_s = self._draws.between(0.5, min(4.0, 0.3 * self._storm_s))
        self._reserve("late", name, 0.0, until_s, {"from_s": 0.0})

    def _lose(self, name: ParticipantId) -> None:
        """Towards the end, for good."""
        from_s = self._storm_s * self._draws.between(0.8, 0.95)
        self._reserve("kill", name, from_s, math.inf, {})

    def _strike(
        self,
        kind: str,
        name: ParticipantId,
        length_s: float | None,
        takes_s: float = 0.0,
        *,
        stops: bool = True,
        **more: object,
    ) -> bool:
        """Strike somewhere in the storm, if there is room. takes_s: real time that a fault without an end takes."""
        length_s = None if length_s is None else min(length_s, self._storm_s / 3.0)
        room_s = length_s or takes_s
        for _ in range(_TRIES):
            from_s = _CALM_START_S + self._draws.unit() * (self._storm_s - _CALM_START_S - room_s)
            if stops and not self._is_free(kind, name, from_s, from_s + room_s):
                continue
            until_s = None if length_s is None else from_s + length_s
            if self._reserve(kind, name, from_s, until_s, dict(more), takes_s if stops else None):
                return True
        return False

    def _is_free(self, kind: str, name: ParticipantId, from_s: float, until_s: float) -> bool:
        if any(
            from_s < end_s + _APART_S and start_s < until_s + _APART_S
            for start_s, end_s in self._taken[name]
        ):
            return False
        if kind not in {"kill", "impostor"} or name == WORLD_SIM:
            return True
        return not any(
            start_s - _OUTAGE_MARGIN_S < moment_s < end_s + _OUTAGE_MARGIN_S
            for start_s, end_s in self._taken[WORLD_SIM]
            for moment_s in (from_s, until_s)
        )

    def _reserve(
        self,
        kind: str,
        name: ParticipantId,
        from_s: float,
        until_s: float | None,
        more: Tree,
        takes_s: float | None = 0.0,
    ) -> bool:
        """Add a fault, unless the others exclude it."""
        tree: Tree = {"kind": kind, "who": [name], "from_s": short(from_s * self._pace)} | more
        if until_s is not None and until_s < math.inf:
            tree["until_s"] = short(until_s * self._pace)
        fault = msgspec.convert(tree, KINDS[kind])
        if any(complaints_of_faults([fault], self._scenario, self._faults)):
            return False
        self._faults.append(fault)
        if takes_s is not None:
            self._taken[name].append((from_s, from_s + takes_s if until_s is None else until_s))
        return True
