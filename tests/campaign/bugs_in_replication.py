"""Bugs in replication: merging, acknowledging, refusing and numbering messages, reading version vectors."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from campaign.planting import (
    Patch,
    density,
    has,
    ledger,
    minimum,
    mutant,
    now_and_then,
    replace_kernel,
    set_weight,
    supervised,
    wrap,
)
from kantor_agent.belief.belief import Belief
from kantor_protocol.base.machine import EVERYBODY
from kantor_protocol.base.varint import MALFORMED
from kantor_protocol.replication.gossip import Gossip
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.faults.links import Hostile
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.wire import version_vector as reader
from support.replication.replicas import read_logs


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

    wrap(patch, Replica, "merge", make)


@mutant("min: takes the larger of two weights", minimum)
def maximum_instead_of_minimum(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, rows: np.ndarray) -> None:
        for _, _, index, value in rows.tolist():
            if value > self.weights[index] and not self.config.ledger:
                set_weight(self.store, index, value)

    _merging(patch, merge)


@mutant("min: takes the mean of two weights", minimum)
def mean_instead_of_minimum(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, rows: np.ndarray) -> None:
        for index in np.flatnonzero(self.weights < weights).tolist():
            set_weight(self.store, index, (int(weights[index]) + int(self.weights[index])) // 2)

    _merging(patch, merge)


@mutant("the last message wins: a weight is what it says", minimum)
def overwriting_merge(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, rows: np.ndarray) -> None:
        for _, _, index, value in rows.tolist():
            if value != self.weights[index]:
                set_weight(self.store, index, value)

    _merging(patch, merge)


@mutant("ledger: spending that is known already is subtracted once more", ledger)
def additive_delta_without_dedupe(patch: Patch) -> None:
    def merge(self: Replica, _: np.ndarray, lengths: np.ndarray, rows: np.ndarray) -> None:
        for origin, position, index, value in rows.tolist():
            held = lengths[origin] if origin < lengths.shape[0] else 0
            if position < held and origin != self.config.me and self.weights[index] > 0:
                set_weight(self.store, index, max(0, int(self.weights[index]) - value))

    _merging(patch, merge)


@mutant("ledger: what another has spent is put into the own log as well", ledger)
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


@mutant("ledger: an entry that was learnt leaves its weight as it was", ledger)
def learning_without_lowering(patch: Patch) -> None:
    def merge(self: Replica, weights: np.ndarray, _: np.ndarray, __: np.ndarray) -> None:
        for index in np.flatnonzero(self.weights < weights).tolist()[:1]:
            set_weight(self.store, index, int(weights[index]))

    _merging(patch, merge)


@mutant("the newest own log entry is dropped now and then", ledger)
def dropping_the_newest_entry(patch: Patch) -> None:
    def make(spend: Any) -> Any:
        def spent(self: Belief, x_m: float, y_m: float) -> bytes:
            packed: bytes = spend(self, x_m, y_m)
            store, me = self.replica.store, self.replica.config.me
            if packed and store.length[me] % 20 == 0 and self.replica.config.ledger:
                store.length[me] -= 1
            return packed

        return spent

    wrap(patch, Belief, "spend", make)


@mutant(
    "a participant that hears of a new incarnation forgets the end of a log",
    has(Kill, disk=("torn", "lost")),
)
def forgetting_while_growing(patch: Patch) -> None:
    def make(widen: Any) -> Any:
        def widened(self: Replica, slots: int) -> None:
            widen(self, slots)
            longest = int(np.argmax(self.store.length))
            self.store.length[longest] = max(0, int(self.store.length[longest]) - 1)

        return widened

    wrap(patch, Replica, "_widen", make)


@mutant("what is sent counts as heard: nothing is ever repeated or forwarded", density)
def inventing_acknowledgements(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Replica, target: int = -1) -> tuple[bytes, bytes, bytes]:
            parts: tuple[bytes, bytes, bytes] = compose(self, target)
            slots = self.origins
            self.store.known[:, :slots] = np.maximum(self.store.known[:, :slots], self.store.length)
            return parts

        return composed

    wrap(patch, Replica, "compose", make)


@mutant("no participant passes on what it knows of others", ledger)
def forgetting_to_forward(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Replica, target: int = -1) -> tuple[bytes, bytes, bytes]:
            slots, me = self.origins, self.config.me
            foreign = np.arange(slots) != me
            known = self.store.known[:, :slots]
            known[:, foreign] = np.maximum(known[:, foreign], self.store.length[foreign])
            parts: tuple[bytes, bytes, bytes] = compose(self, target)
            return parts

        return composed

    wrap(patch, Replica, "compose", make)


@mutant("a hostile message is taken for a sound one", has(Hostile))
def hostile_message_taken_in(patch: Patch) -> None:
    def make(hear: Any) -> Any:
        def heard(self: Gossip, *arguments: Any) -> None:
            before = self.refused
            hear(self, *arguments)
            self.refused = before

        return heard

    wrap(patch, Gossip, "receive", make)


@mutant("sound messages are refused now and then")
def sound_message_refused(patch: Patch) -> None:
    due = now_and_then(100)

    def make(merge: Any) -> Any:
        def merged(self: Replica, *parts: Any) -> bool:
            return not due() and merge(self, *parts)

        return merged

    wrap(patch, Replica, "merge", make)


@mutant("a new incarnation counts its messages from 1 again", has(Kill, disk=("torn", "lost")))
def sequences_used_again(patch: Patch) -> None:
    def make(say: Any) -> Any:
        def said(self: Gossip, *arguments: Any, **options: Any) -> Any:
            envelope = say(self, *arguments, **options)
            self._said = getattr(self, "_said", 0) + 1
            return msgspec.structs.replace(envelope, sequence=self._said)

        return said

    wrap(patch, Gossip, "compose", make)


@mutant("a robot that has lost its supervisor talks to it for ever", supervised)
def supervisor_never_given_up(patch: Patch) -> None:
    def make(say: Any) -> Any:
        def said(self: Gossip, *arguments: Any, **options: Any) -> Any:
            self._unheard_steps = 0
            return say(self, *arguments, **options)

        return said

    wrap(patch, Gossip, "compose", make)


@mutant("a robot that has given its supervisor up never returns to it", supervised)
def supervisor_never_heard_again(patch: Patch) -> None:
    def make(say: Any) -> Any:
        def said(self: Gossip, *arguments: Any, **options: Any) -> Any:
            if getattr(self, "_lonely", False):
                self._unheard_steps = 1000
            envelope = say(self, *arguments, **options)
            self._lonely = self._supervisor >= 0 and envelope.target == EVERYBODY
            return envelope

        return said

    wrap(patch, Gossip, "compose", make)


# The reader of version vectors in `wire`.


def _count_first_incarnations(version_vector: bytes, roster: int, parts: int) -> int:
    numbers = 0
    for i in range(len(version_vector)):
        numbers += version_vector[i] < 128
    return roster if numbers == roster * parts else MALFORMED


@mutant("a version vector with a second incarnation is malformed", has(Kill, disk=("torn", "lost")))
def second_incarnation_refused(patch: Patch) -> None:
    replace_kernel(patch, reader, "count_ids", _count_first_incarnations)


def _count_any(version_vector: bytes, roster: int, parts: int) -> int:
    numbers = 0
    for i in range(len(version_vector)):
        numbers += version_vector[i] < 128
    block = roster * parts
    return max(1, (numbers + block - 1) // block) * roster


@mutant("a version vector may have any number of numbers", has(Hostile))
def version_vector_of_any_length(patch: Patch) -> None:
    replace_kernel(patch, reader, "count_ids", _count_any)
