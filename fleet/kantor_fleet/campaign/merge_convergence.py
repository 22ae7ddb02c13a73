"""All messages of a mission, merged in another order and twice, give the same replica.

A replica is a join of deltas (Almeida, Shoker & Baquero, 2018): idempotent, commutative, associative. Here a
participant that took no part in the mission merges every message of a record, in the order in which they were
sent and in one that is drawn, until they bring nothing new.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from kantor_fleet.campaign.keyed_draws import KeyedDraws
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.replication.gossip import build_replica
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import GossipMessage, decode_gossip
from kantor_protocol.wire.weights import Units
from kantor_worldsim.record.records import Batch, Record

_SUBJECT = 1001
_LATE = 40
"""A message is merged after at most so many that were sent later."""
_PASSES = 1000


class _Sent(NamedTuple):
    incarnation_id: int
    """The sender's."""
    message: GossipMessage


def merge_shuffled(scenario: Scenario, seed: int, records: Iterable[Record]) -> Iterable[str]:
    """A violation if the order matters. None for a mission on a map, which has no weights."""
    sent = list(_sent(scenario, records)) if not scenario.mapping else []
    incarnation = 1 + max((each.message.incarnation for each in sent), default=0)
    if not sent or incarnation > INCARNATIONS_MAX:
        return
    draws = KeyedDraws(seed, _SUBJECT)
    twice = sent + sent
    late = [i + draws.unit() * _LATE for i in range(len(twice))]
    shuffled = [twice[i] for i in sorted(range(len(twice)), key=late.__getitem__)]
    one, other = (_merged(scenario, incarnation, order) for order in (sent, shuffled))
    if one.config.ledger and not np.array_equal(one.store.length, other.store.length):
        yield "join: logs have other lengths when they are merged in another order"
    elif not np.array_equal(one.weights, other.weights):
        yield "join: weights are others when messages are merged in another order, and twice"


def _sent(scenario: Scenario, records: Iterable[Record]) -> Iterable[_Sent]:
    places = {name: i for i, name in enumerate(scenario.roster)}
    for record in records:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            for envelope in step_record.outputs.outbox if step_record.outputs else ():
                message = decode_gossip(envelope.body)
                place = places[step_record.name]
                yield _Sent(place + message.incarnation * len(places), message)


def _merged(scenario: Scenario, incarnation: int, sent: Sequence[_Sent]) -> Replica:
    """The replica of a participant that has merged all messages."""
    samples = scenario.samples.count or 0
    units = Units.of(scenario.energy.points, samples)
    replica = build_replica(scenario.roster[0], scenario, units, samples, incarnation)
    before = -1
    for _ in range(_PASSES):
        for source, message in sent:
            replica.merge(
                source, message.version_vector, message.logs, message.claims, message.registers
            )
        replica.end_step()
        held = int(replica.store.length.sum())
        if held == before:
            break
        before = held
    return replica
