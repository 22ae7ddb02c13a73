"""Planted bugs, each switched on by a test only, and the table of who caught them.

A checker that never complains proves nothing until it is seen to complain. Each mutant is a mistake that one
could make in this system, planted at a seam of Python; a campaign's own missions then run until a referee
complains. `python tests/campaign/mutants.py` hunts all of them and writes docs/mutants.md.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from kantor_protocol.replication.replica_kernels import ReplicaArrays
from kantor_worldsim.exchange.in_process import InProcessExchange

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from kantor_agent.belief.belief import Belief
from kantor_agent.robots import density as agent_core
from kantor_agent.robots.density import DensityRobot
from kantor_fleet.campaign.draw import draw
from kantor_fleet.campaign.mission import Trial, attempt
from kantor_fleet.execution.experiment import Case
from kantor_protocol.base.machine import EVERYBODY, WORLD_SIM, Body
from kantor_protocol.node import recovery
from kantor_protocol.node.recovery import InMemoryLog, KillableNode, RecoverableNode, WalContents
from kantor_protocol.replication.gossip import Gossip
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.faults.links import Hostile, Partition
from kantor_protocol.scenario.faults.processes import FullDisk, Impostor, Kill, Late, Pause
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import decode_inputs
from kantor_protocol.wire.weights import WeightsPublisher
from kantor_worldsim.engine import process_faults
from kantor_worldsim.engine.process_faults import ProcessFaults
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.radio.channel import Channel
from kantor_worldsim.world.world import World
from support.replicas import read_logs

LIMIT = 200
"""Missions within which every mutant must be caught."""

TABLE = Path(__file__).parents[2] / "docs" / "mutants.md"

Patch = pytest.MonkeyPatch
Touches = Callable[[Scenario], bool]


class Mutant(NamedTuple):
    """A bug."""

    name: str
    does: str
    plant: Callable[[Patch], None]
    touches: Touches
    """Missions that it can change at all; the others count, and need not run."""


class Catch(NamedTuple):
    """How a mutant was caught."""

    seed: int
    complaint: str
    missions: int
    """Up to and with the one that caught it."""
    wall_s: float


MUTANTS: list[Mutant] = []


def mutant(
    does: str, touches: Touches = lambda _: True
) -> Callable[[Callable[[Patch], None]], Callable[[Patch], None]]:
    """Add a bug to the list under the name of the function that plants it."""

    def add(plant: Callable[[Patch], None]) -> Callable[[Patch], None]:
        MUTANTS.append(Mutant(plant.__name__.replace("_", "-"), does, plant, touches))
        return plant

    return add


def hunt(one: Mutant, limit: int = LIMIT) -> Catch | None:
    """Run the missions of a campaign, from seed 0 on, until one catches the bug; None if none does."""
    started_s = time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        one.plant(patch)
        for seed in range(limit):
            scenario = draw(seed)
            if not one.touches(scenario):
                continue
            trial: Trial = attempt(Case(scenario, seed))
            if trial.violation is not None:
                return Catch(seed, trial.violation, seed + 1, time.monotonic() - started_s)
    return None


# Which missions a bug can change.


def _has(kind: type, **wanted: Any) -> Touches:
    """Missions with such a fault."""
    return lambda scenario: any(
        isinstance(fault, kind)
        and all(getattr(fault, key) in value for key, value in wanted.items())
        for fault in scenario.faults
    )


def _of(fault: type, who: str) -> Touches:
    return lambda scenario: any(isinstance(f, fault) and who in f.who for f in scenario.faults)


def _density(scenario: Scenario) -> bool:
    return not scenario.mapping


def _minimum(scenario: Scenario) -> bool:
    return _density(scenario) and scenario.merge == "min"


def _ledger(scenario: Scenario) -> bool:
    return _density(scenario) and scenario.merge == "ledger"


def _spectral(scenario: Scenario) -> bool:
    return scenario.planner.name == "spectral"


def _supervised(scenario: Scenario) -> bool:
    return scenario.centralized


def _spatial(scenario: Scenario) -> bool:
    return scenario.radio.range_m < 1e9 and not scenario.centralized


# Helpers of bugs.


def _now_and_then(every: int) -> Callable[[], bool]:
    """True at every so many-th question."""
    asked = itertools.count(1)
    return lambda: next(asked) % every == 0


def _wrap(patch: Patch, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
    patch.setattr(owner, name, make(getattr(owner, name)))


def _set(store: ReplicaArrays, index: int, value: int) -> None:
    """What `replica._lower` does, whatever the value."""
    before = int(store.weights[index])
    store.counters[2] += int(value > 0) - int(before > 0)
    store.weights[index] = value
    if store.mark[index] != store.counters[1]:
        store.mark[index] = store.counters[1]
        store.lowered[store.counters[0]] = index
        store.counters[0] += 1


def _merging(
    patch: Patch, merge: Callable[[Replica, np.ndarray, np.ndarray, np.ndarray], None]
) -> None:
    """After each message: merge(replica, weights and lengths before, rows of its log entries)."""

    def make(learn: Any) -> Any:
        def learnt(
            self: Replica, source: int, version_vector: bytes, logs: bytes, *rest: bytes
        ) -> bool:
            weights, lengths = self.weights.copy(), self.store.length.copy()
            taken: bool = learn(self, source, version_vector, logs, *rest)
            rows = read_logs(logs) if taken and self.weights.size else None
            if rows is not None and rows.size:
                merge(self, weights, lengths, rows)
            return taken

        return learnt

    _wrap(patch, Replica, "merge", make)


# Merging.


@mutant("min: takes the larger of two weights", _minimum)
def maximum_instead_of_minimum(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, rows: np.ndarray) -> None:
        for _, _, index, value in rows.tolist():
            if value > self.weights[index] and not self.config.ledger:
                _set(self.store, index, value)

    _merging(patch, merge)


@mutant("min: takes the mean of two weights", _minimum)
def mean_instead_of_minimum(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, rows: np.ndarray) -> None:
        for index in np.flatnonzero(self.weights < weights).tolist():
            _set(self.store, index, (int(weights[index]) + int(self.weights[index])) // 2)

    _merging(patch, merge)


@mutant("the last word wins: a weight is what the message says", _minimum)
def overwriting_merge(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, rows: np.ndarray) -> None:
        for _, _, index, value in rows.tolist():
            if value != self.weights[index]:
                _set(self.store, index, value)

    _merging(patch, merge)


@mutant("ledger: spending that is known already is subtracted once more", _ledger)
def additive_delta_without_dedupe(patch: Patch) -> None:
    def merge(self: Replica, _: np.ndarray, lengths: np.ndarray, rows: np.ndarray) -> None:
        for origin, position, index, value in rows.tolist():
            held = lengths[origin] if origin < lengths.shape[0] else 0
            if position < held and origin != self.config.me and self.weights[index] > 0:
                _set(self.store, index, max(0, int(self.weights[index]) - value))

    _merging(patch, merge)


@mutant("ledger: what another has spent is put into the own log as well", _ledger)
def accepting_anothers_log_as_own(patch: Patch) -> None:
    def merge(self: Replica, _: np.ndarray, lengths: np.ndarray, rows: np.ndarray) -> None:
        me = self.config.me
        for origin, position, index, value in rows.tolist():
            held = lengths[origin] if origin < lengths.shape[0] else 0
            if position >= held and origin != me:
                self.reserve(1)
                length = int(self.store.length[me])
                self.store.logs[me, length] = index, value
                self.store.length[me] += 1

    _merging(patch, merge)


@mutant("ledger: an entry that was learnt leaves its weight as it was", _ledger)
def learning_without_lowering(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, __: np.ndarray) -> None:
        for index in np.flatnonzero(self.weights < weights).tolist()[:1]:
            _set(self.store, index, int(weights[index]))

    _merging(patch, merge)


@mutant("the newest own log entry is dropped now and then", _ledger)
def dropping_the_newest_entry(patch: Patch) -> None:
    def make(spend: Any) -> Any:
        def spent(self: Belief, x_m: float, y_m: float) -> bytes:
            packed: bytes = spend(self, x_m, y_m)
            store, me = self.replica.store, self.replica.config.me
            if packed and store.length[me] % 20 == 0 and self.replica.config.ledger:
                store.length[me] -= 1
            return packed

        return spent

    _wrap(patch, Belief, "spend", make)


@mutant(
    "whoever hears of a new incarnation forgets the end of a log", _has(Kill, disk=("torn", "lost"))
)
def forgetting_while_growing(patch: Patch) -> None:
    def make(widen: Any) -> Any:
        def widened(self: Replica, slots: int) -> None:
            widen(self, slots)
            longest = int(np.argmax(self.store.length))
            self.store.length[longest] = max(0, int(self.store.length[longest]) - 1)

        return widened

    _wrap(patch, Replica, "_widen", make)


@mutant("what is sent counts as heard: nothing is ever repeated or forwarded", _density)
def inventing_acknowledgements(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Replica, target: int = -1) -> tuple[bytes, bytes, bytes]:
            told: tuple[bytes, bytes, bytes] = compose(self, target)
            slots = self.origins
            self.store.known[:, :slots] = np.maximum(self.store.known[:, :slots], self.store.length)
            return told

        return composed

    _wrap(patch, Replica, "compose", make)


@mutant("nobody passes on what it knows of others", _ledger)
def forgetting_to_forward(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Replica, target: int = -1) -> tuple[bytes, bytes, bytes]:
            slots, me = self.origins, self.config.me
            foreign = np.arange(slots) != me
            known = self.store.known[:, :slots]
            known[:, foreign] = np.maximum(known[:, foreign], self.store.length[foreign])
            told: tuple[bytes, bytes, bytes] = compose(self, target)
            return told

        return composed

    _wrap(patch, Replica, "compose", make)


# Radio and channel.


@mutant("the radio reaches 5 % further", _spatial)
def range_plus_five_percent(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: Channel, *arguments: Any, **named: Any) -> None:
            init(self, *arguments, **named)
            self._law = self._law._replace(range_m=1.05 * self._law.range_m)
            self._arguments = (*self._law, *self._field)

        return made

    _wrap(patch, Channel, "__init__", make)


@mutant(
    "the supervisor is heard however far away",
    lambda s: s.supervisor.range_m < 1e9 and s.centralized,
)
def supervisors_range_ignored(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: Channel, *arguments: Any, **named: Any) -> None:
            init(self, *arguments, **named)
            self._law = self._law._replace(supervisor_range_m=np.inf)
            self._arguments = (*self._law, *self._field)

        return made

    _wrap(patch, Channel, "__init__", make)


@mutant("a partition stops one direction only", _has(Partition))
def partition_leaks_one_way(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: Simulation, *arguments: Any, **named: Any) -> None:
            init(self, *arguments, **named)
            if self._faults is not None:
                places = np.arange(self._faults.table.severed.shape[1])
                self._faults.table.severed[:, places[:, None] > places[None, :]] = 0

        return made

    _wrap(patch, Simulation, "__init__", make)


@mutant("now and then somebody gets what was for another")
def delivery_to_the_wrong_robot(patch: Patch) -> None:
    due = _now_and_then(50)

    def make(take: Any) -> Any:
        def taken(self: Channel, name: str, now_ns: int) -> Any:
            others = [other for other in self._roster if other != name]
            return take(self, others[0] if others and due() else name, now_ns)

        return taken

    _wrap(patch, Channel, "take", make)


@mutant(
    "messages are heard up to a period before they arrive",
    lambda s: s.radio.delay_s + s.radio.jitter_s > 0.0,
)
def heard_before_it_is_due(patch: Patch) -> None:
    def make(take: Any) -> Any:
        return lambda self, name, now_ns: take(self, name, now_ns + 200_000_000)

    _wrap(patch, Channel, "take", make)


@mutant("one delivery in a hundred vanishes on the way")
def a_delivery_vanishes(patch: Patch) -> None:
    due = _now_and_then(100)

    def make(take: Any) -> Any:
        def taken(self: Channel, name: str, now_ns: int) -> Any:
            envelopes = take(self, name, now_ns)
            return envelopes[:-1] if envelopes and due() else envelopes

        return taken

    _wrap(patch, Channel, "take", make)


@mutant("one delivery in a hundred comes twice, though nobody said so")
def a_delivery_comes_twice(patch: Patch) -> None:
    due = _now_and_then(100)

    def make(take: Any) -> Any:
        def taken(self: Channel, name: str, now_ns: int) -> Any:
            envelopes = take(self, name, now_ns)
            return (*envelopes, envelopes[-1]) if envelopes and due() else envelopes

        return taken

    _wrap(patch, Channel, "take", make)


@mutant("who is started finds what arrived while it was dead", _has(Kill))
def letters_to_the_dead_arrive(patch: Patch) -> None:
    patch.setattr(Channel, "lose", lambda *_: None)


@mutant("world-sim forgets what was under way when it starts again", _of(Kill, WORLD_SIM))
def world_sim_forgets_what_was_under_way(patch: Patch) -> None:
    def make(rebuilt: Any) -> Any:
        def forgetful(self: Simulation) -> Simulation:
            simulation: Simulation = rebuilt(self)
            simulation.channel.clear()
            return simulation

        return forgetful

    _wrap(patch, Simulation, "rebuilt", make)


@mutant("a hostile message is taken for a sound one", _has(Hostile))
def hostile_message_taken_in(patch: Patch) -> None:
    def make(hear: Any) -> Any:
        def heard(self: Gossip, *arguments: Any) -> None:
            before = self.refused
            hear(self, *arguments)
            self.refused = before

        return heard

    _wrap(patch, Gossip, "receive", make)


@mutant("sound messages are refused now and then")
def sound_message_refused(patch: Patch) -> None:
    due = _now_and_then(100)

    def make(hear: Any) -> Any:
        def heard(self: Gossip, inbox: Any, learn: Any) -> None:
            hear(self, inbox, lambda *parts: not due() and learn(*parts))

        return heard

    _wrap(patch, Gossip, "receive", make)


@mutant("a new incarnation counts its messages from 1 again", _has(Kill, disk=("torn", "lost")))
def sequences_used_again(patch: Patch) -> None:
    def make(say: Any) -> Any:
        def said(self: Gossip, *arguments: Any) -> Any:
            envelope = say(self, *arguments)
            self._said = getattr(self, "_said", 0) + 1
            return msgspec.structs.replace(envelope, sequence=self._said)

        return said

    _wrap(patch, Gossip, "compose", make)


@mutant("a robot that has lost its supervisor talks to it for ever", _supervised)
def supervisor_never_given_up(patch: Patch) -> None:
    def make(say: Any) -> Any:
        def said(self: Gossip, *arguments: Any) -> Any:
            self._unheard_steps = 0
            return say(self, *arguments)

        return said

    _wrap(patch, Gossip, "compose", make)


@mutant("a robot that has given its supervisor up never returns to it", _supervised)
def supervisor_never_heard_again(patch: Patch) -> None:
    def make(say: Any) -> Any:
        def said(self: Gossip, *arguments: Any) -> Any:
            if getattr(self, "_lonely", False):
                self._unheard_steps = 1000
            envelope = say(self, *arguments)
            self._lonely = self._supervisor >= 0 and envelope.target == EVERYBODY
            return envelope

        return said

    _wrap(patch, Gossip, "compose", make)


# Energy, motion and goals.


@mutant("a robot ships one unit more than a point holds", _density)
def overspending_by_one_unit(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: Belief, walk: Any, units: Any, held: Any) -> None:
            init(self, walk, msgspec.structs.replace(units, point=units.point + 1), held)

        return made

    _wrap(patch, Belief, "__init__", make)


@mutant("a robot takes one step more than its budget", _density)
def one_step_more_than_the_budget(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: DensityRobot, *arguments: Any) -> None:
            init(self, *arguments)
            self._budget += 1

        return made

    _wrap(patch, DensityRobot, "__init__", make)


@mutant("a new incarnation begins with a full battery", _has(Kill, disk=("torn", "lost")))
def energy_gauge_forgotten(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: DensityRobot, *arguments: Any) -> None:
            init(self, *arguments)
            self._energy_spent = 0

        return made

    _wrap(patch, DensityRobot, "__init__", make)


@mutant("the world counts a point twice now and then", _density)
def world_counts_energy_twice(patch: Patch) -> None:
    def make(spend: Any) -> Any:
        def spent(self: World, body: Any, packed: bytes) -> list[str]:
            told: list[str] = spend(self, body, packed)
            body.energy_spent += body.energy_spent % 10 == 5
            return told

        return spent

    _wrap(patch, World, "_spend", make)


@mutant("robots drive 1 % too fast, and the world lets them")
def speed_limit_one_percent_too_high(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: World, scenario: Scenario, *arguments: Any) -> None:
            init(self, scenario, *arguments)
            self._speed_m_s *= 1.01

        return made

    def faster(explore: Any) -> Any:
        return lambda self, dt_s: explore(self, 1.01 * dt_s)

    _wrap(patch, World, "__init__", make)
    _wrap(patch, DensityRobot, "_explore", faster)


@mutant(
    "who takes a body over drives for the time since the start", _has(Kill, disk=("torn", "lost"))
)
def a_new_incarnation_leaps(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: DensityRobot, *arguments: Any) -> None:
            init(self, *arguments)
            if self._step:
                self._now_ns, self._period_ns = 0, 10 * self._period_ns

        return made

    _wrap(patch, DensityRobot, "__init__", make)


@mutant("a weight rises now and then", _density)
def weight_that_rises(patch: Patch) -> None:
    def make(learn: Any) -> Any:
        def learnt(self: Replica, *arguments: Any) -> bool:
            taken: bool = learn(self, *arguments)
            index = int(np.argmin(self.weights)) if self.weights.size else 0
            if self.store.counters[1] % 50 == 0 and self.weights.size:
                _set(self.store, index, int(self.weights[index]) + 1)
            return taken

        return learnt

    _wrap(patch, Replica, "merge", make)


@mutant("what is published misses an entry now and then", _density)
def published_vector_differs(patch: Patch) -> None:
    due = _now_and_then(20)

    def make(step: Any) -> Any:
        def stepped(self: WeightsPublisher, lowered: np.ndarray, *, last: bool) -> bytes:
            packed: bytes = step(self, lowered[1:] if due() else lowered, last=last)
            return packed

        return stepped

    _wrap(patch, WeightsPublisher, "step", make)


@mutant("a robot keeps to a goal that has no weight left", lambda s: s.planner.name == "transport")
def goal_without_weight(patch: Patch) -> None:
    def make(explore: Any) -> Any:
        def explored(self: DensityRobot, dt_s: float) -> bytes:
            before = self._goal
            packed: bytes = explore(self, dt_s)
            self._goal = before or self._goal
            return packed

        return explored

    _wrap(patch, agent_core.DensityRobot, "_explore", make)


@mutant("a register is not the sum over its places", _spectral)
def register_off_by_one(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Registers, target: int = -1) -> bytes:
            self.values[self.me, 1:2] += 1
            told: bytes = compose(self, target)
            return told

        return composed

    _wrap(patch, Registers, "compose", make)


# Lives.


@mutant("a step is noted after it was told, and the diary is trusted", _has(Kill))
def late_write(patch: Patch) -> None:
    def kill(self: KillableNode) -> None:
        self._node = None
        del self._wal._inputs[-1:]

    patch.setattr(KillableNode, "kill", kill)
    patch.setattr(
        recovery,
        "_covers",
        lambda entries, body: entries.initial_state.incarnation == body.incarnation,
    )


@mutant("a torn diary is taken for whole", _has(Kill, disk=("torn",)))
def torn_diary_taken_for_whole(patch: Patch) -> None:
    patch.setattr(
        recovery,
        "_covers",
        lambda entries, body: entries.initial_state.incarnation == body.incarnation,
    )


@mutant("who starts again knows nothing, not even that it has lived", _has(Kill))
def amnesia(patch: Patch) -> None:
    def start(self: KillableNode, body: Body, disk: str) -> tuple[int, int]:
        self._wal = InMemoryLog()
        newborn = Body(body.pose, 0, 0, body.incarnation)
        self._node = RecoverableNode(self._build, self._wal, newborn)
        return body.incarnation, body.step

    patch.setattr(KillableNode, "start", start)


@mutant(
    "after a lost disk the old incarnation goes on with an empty log",
    _has(Kill, disk=("torn", "lost")),
)
def old_incarnation_used_again(patch: Patch) -> None:
    patch.setattr(recovery, "_reincarnated", lambda body: body)


@mutant("every start is a new incarnation, though the diary is whole", _has(Kill, disk=("kept",)))
def needless_incarnation(patch: Patch) -> None:
    def read(self: InMemoryLog) -> WalContents | None:
        return None

    patch.setattr(InMemoryLog, "read", read)


@mutant("asked again, a robot does its step once more", _has(Kill, mid_step=(True,)))
def answering_a_turn_twice(patch: Patch) -> None:
    def step_encoded(self: RecoverableNode, entry: bytes) -> Any:
        self._wal.append(entry)
        return self._advance(decode_inputs(entry))

    patch.setattr(RecoverableNode, "step_encoded", step_encoded)


@mutant("a step is not counted now and then", _density)
def lost_step_count(patch: Patch) -> None:
    def make(step: Any) -> Any:
        def stepped(self: DensityRobot, inputs: Any) -> Any:
            self._step -= self._step % 40 == 39
            return step(self, inputs)

        return stepped

    _wrap(patch, DensityRobot, "step", make)


def _ignoring(patch: Patch, kind: type) -> None:
    """Whoever runs the mission lets those act whom such a fault stops."""

    def make(init: Any) -> Any:
        def made(self: ProcessFaults, *arguments: Any, **named: Any) -> None:
            init(self, *arguments, **named)
            self._stops = {
                name: [window for window in windows if not isinstance(window.fault, kind)]
                for name, windows in self._stops.items()
            }

        return made

    _wrap(patch, ProcessFaults, "__init__", make)


@mutant("the dead go on acting", _has(Kill))
def dead_robot_still_acts(patch: Patch) -> None:
    _ignoring(patch, Kill)
    patch.setattr(KillableNode, "kill", lambda _: None)


@mutant("who is paused goes on acting", _has(Pause))
def paused_robot_still_acts(patch: Patch) -> None:
    _ignoring(patch, Pause)


@mutant("who cannot note a step takes it nevertheless", _has(FullDisk))
def full_disk_ignored(patch: Patch) -> None:
    _ignoring(patch, FullDisk)


@mutant("who joins late acts from the start", _has(Late))
def late_joiner_comes_early(patch: Patch) -> None:
    _ignoring(patch, Late)


@mutant("an impostor is let in", _has(Impostor))
def impostor_let_in(patch: Patch) -> None:
    patch.setattr(InProcessExchange, "pretend", lambda _self, _name: True)


@mutant(
    "the world judges by the clock of the robot",
    lambda s: any(f.__struct_config__.tag == "clock" for f in s.faults),
)
def clock_skew_leaks_into_physics(patch: Patch) -> None:
    def make(step_record: Any) -> Any:
        def acted(self: Simulation, step: Any) -> Any:
            return step_record(self, msgspec.structs.replace(step, skew_ns=0))

        return acted

    _wrap(patch, Simulation, "_act", make)


@mutant(
    "a clock fault does nothing",
    lambda s: any(f.__struct_config__.tag == "clock" for f in s.faults),
)
def clock_stays_right(patch: Patch) -> None:
    patch.setattr(process_faults.ProcessFaults, "skew_ns", lambda *_: 0)


def write(hunted: list[tuple[Mutant, Catch | None]], path: Path = TABLE) -> None:
    """The table, for the repository."""
    caught = sum(catch is not None for _, catch in hunted)
    lines = [
        "# Planted bugs, and who caught them",
        "",
        f"{caught} of {len(hunted)} caught within {LIMIT} missions of `kantor campaign`, from seed 0 on. Written by",
        "`python tests/campaign/mutants.py`; `tests/campaign/test_mutants.py` plants every one of them.",
        "",
        "| mutant | what it does | caught at seed | by rule | complaint |",
        "|---|---|---:|---|---|",
    ]
    for one, catch in hunted:
        rule, _, complaint = catch.complaint.partition(": ") if catch else ("**nobody**", "", "")
        told = complaint.replace("|", "\\|")[:90]
        lines.append(
            f"| {one.name} | {one.does} | {catch.seed if catch else ''} | {rule} | {told} |"
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> int:
    """Hunt all mutants, or those that are named."""
    wanted = sys.argv[1:]
    hunted = []
    for one in MUTANTS:
        if not wanted or one.name in wanted:
            catch = hunt(one)
            hunted.append((one, catch))
            print(f"{one.name:38} {catch or 'SURVIVES'}", flush=True)
    if not wanted:
        write(hunted)
    return int(any(catch is None for _, catch in hunted))


if __name__ == "__main__":
    sys.exit(main())
