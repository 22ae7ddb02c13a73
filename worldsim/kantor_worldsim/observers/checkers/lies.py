"""The rules beside declared liars: their lies are named and are no violations, and the honest keep every rule.

A scenario says which robots lie (`scenario/faults/liars.py`). What one of them says against the rules is a lie of its
own, and counts under its name. Its body, its energy and its process obey the same rules as all others, and so does
everything that the honest say: but for the log of a robot that overstates or forks it, which they hold in good faith.
Of what such a log has taken from their views only the sum is known: what its robot had energy for.
"""

from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Outputs, ParticipantId, State
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.faults.liars import FALSE_LOGS, liars_of
from kantor_protocol.wire.messages import GossipMessage, RefusedError, decode_gossip
from kantor_worldsim.observers.metrics.gossip_reader import (
    claims_of,
    incarnations_of,
    registers_of,
)
from kantor_worldsim.record.records import Batch, Opening, StepRecord

Report = Callable[[str, ParticipantId, str], None]
"""Takes the rule, the participant and the text of a violation."""

_OF_WORDS = frozenset({"ledger", "ruling", "map", "union", "truth", "claim", "silence"})
"""Rules on what a participant says."""

Word = tuple[int, ...]
"""Stamp and contents of a claim or register."""


class LiarChecker:
    """Follows a mission with declared liars.

    Rules
    -----
    early       an honest robot finishes only when what honest spending leaves is no more than what robots with false
                logs had energy for
    claim       a claim or register of another is passed on as its origin has sent it
    silence     a robot sends to all that it may send to (of declared liars alone; an honest one cannot be told from
                one that is not guided any more)
    """

    def __init__(self, opening: Opening, report: Report) -> None:
        scenario = opening.scenario
        self.told: Counter[ParticipantId] = Counter()
        """Lies of each liar."""
        self._names = scenario.roster
        self._liars = liars_of(scenario.faults)
        self._silent = liars_of(scenario.faults, "silence")
        forgers = liars_of(scenario.faults, *FALSE_LOGS)
        self.false_logs = frozenset(self._names.index(name) for name in forgers)
        """The places of robots whose own logs are not what they have consumed, or seen."""
        self._report = report
        self._scenario, self._sample_units = scenario, opening.units.sample
        self._energy_units = scenario.steps_per_robot * opening.units.point
        """What one robot can ship."""
        self._false = np.zeros(opening.samples_m.shape[0], dtype=np.int64)
        """(N,) units shipped by robots with false logs."""
        self._pairs = Pairs()
        self._finished: set[ParticipantId] = set()
        self._sent: tuple[dict[int, set[Word]], dict[int, set[Word]]] = ({}, {})
        """Claims and registers that each origin has sent of its own."""

    @property
    def liar_places(self) -> list[int]:
        """The places of all liars."""
        return [self._names.index(name) for name in sorted(self._liars)]

    def takes(self, rule: str, who: ParticipantId) -> bool:
        """Whether a violation is a lie, which is then counted."""
        if who not in self._liars or rule not in _OF_WORDS:
            return False
        self.told[who] += 1
        return True

    def is_false(self, origin: int) -> bool:
        """Whether the log of an incarnation may be passed on in good faith, and be false."""
        return origin % len(self._names) in self.false_logs

    def check(self, batch: Batch, consumed: npt.NDArray[np.int64]) -> None:
        """Check what is said in one batch. consumed: (N,) units shipped by all, the batch included."""
        for step_record in batch.step_records:
            outputs = step_record.outputs
            if outputs is None or step_record.name not in self._names:
                continue
            if self._names.index(step_record.name) in self.false_logs:
                self._note_false(outputs)
        left = self._left(consumed)
        for step_record in batch.step_records:
            if step_record.outputs is not None and step_record.name in self._names:
                self._check_end(step_record, step_record.outputs, int(left.sum()))
                self._check_words(step_record, step_record.outputs)

    def check_view(
        self, place: int, view: npt.NDArray[np.int64], consumed: npt.NDArray[np.int64]
    ) -> None:
        """The rule `credit` beside false logs: a view has lost no more than these could take, of all samples together.

        Not of a robot with a false log: after a restart its own lies may come back to it.
        """
        if place in self.false_logs:
            return
        missing = int(np.maximum(self._left(consumed) - view, 0).sum())
        if missing > self.allowance:
            what = f"its view lacks {missing} units, and liars could take {self.allowance}"
            self._report("credit", self._names[place], what)

    def check_lost(self, who: ParticipantId, units: int) -> None:
        """The rule `ledger` beside false logs, whose entries nobody else knows: they took no more than they could."""
        if units > self.allowance:
            what = f"false logs took {units} units, and liars could take {self.allowance}"
            self._report("ledger", who, what)

    @property
    def allowance(self) -> int:
        """Units that false logs can have taken from a view."""
        return len(self.false_logs) * self._energy_units

    def _note_false(self, outputs: Outputs) -> None:
        spent = self._pairs.decode(outputs.spent, self._false.shape[0])
        if spent is not None:
            np.add.at(self._false, spent[0], spent[1])

    def _left(self, consumed: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(N,) units left by all but robots with false logs."""
        return np.maximum(self._sample_units - consumed + self._false, 0)

    def _check_end(self, step_record: StepRecord, outputs: Outputs, left: int) -> None:
        """The rule `early`. left: units that honest spending leaves."""
        name = step_record.name
        if outputs.state is not State.FINISHED or name in self._finished or name in self._liars:
            return
        self._finished.add(name)
        if left > self.allowance:
            what = f"finishes with {left} units left, and liars could take {self.allowance}"
            self._report("early", name, what)

    def _check_words(self, step_record: StepRecord, outputs: Outputs) -> None:
        name = step_record.name
        if name in self._silent:
            self._check_silence(name, outputs)
        if not (self._scenario.claiming or self._scenario.register_width):
            return
        for envelope in outputs.outbox:
            try:
                message = decode_gossip(envelope.body)
            except RefusedError:
                continue
            self._check_claims(name, message)

    def _check_silence(self, name: ParticipantId, outputs: Outputs) -> None:
        targets = {envelope.target for envelope in outputs.outbox}
        if targets in ({EVERYBODY}, {SUPERVISOR}):
            return
        missing = set(self._names) - targets - {name}
        if missing:
            self._report("silence", name, f"sends nothing to {', '.join(sorted(missing))}")

    def _check_claims(self, name: ParticipantId, message: GossipMessage) -> None:
        own = message.incarnation * len(self._names) + self._names.index(name)
        said = list(self._words(message))
        for sent, origin, word in said:
            if origin == own:
                sent.setdefault(origin, set()).add(word)
        foreign = ((sent, origin, word) for sent, origin, word in said if origin != own)
        for sent, origin, word in foreign:
            if word not in sent.get(origin, ()):
                whose = self._names[origin % len(self._names)]
                what = f"passes on what {whose} never said, under stamp {word[0]}"
                self._report("claim", name, what)
                return

    def _words(self, message: GossipMessage) -> Iterator[tuple[dict[int, set[Word]], int, Word]]:
        """Claims and registers in a message: where their kind is noted, their origin, and what they say."""
        scenario, claiming = self._scenario, self._scenario.claiming
        origins = incarnations_of(message.version_vector, len(self._names), claims=claiming)
        for origin, *claim in claims_of(message.claims) if claiming else ():
            yield self._sent[0], origin, tuple(claim)
        if scenario.register_width and message.registers:
            for origin, *register in registers_of(message.registers, origins):
                yield self._sent[1], origin, tuple(register)
