"""All that was ever said in a mission, learned in another order and twice, comes to the same.

A replica is a join of deltas (Almeida, Shoker & Baquero, 2018): idempotent, commutative, associative. Here
somebody who was not there learns every message of a record, in the order in which they were sent and in one
that is drawn, until there is nothing new in them.
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
"""A message is learned after at most so many that were sent later."""
_PASSES = 1000


class _Said(NamedTuple):
    slot: int
    """Of who said it."""
    news: GossipMessage


def differing(scenario: Scenario, seed: int, records: Iterable[Record]) -> Iterable[str]:
    """What is wrong with that, if anything; nothing for a mission with a map, which has no weights."""
    said = list(_said(scenario, records)) if not scenario.mapping else []
    incarnation = 1 + max((each.news.incarnation for each in said), default=0)
    if not said or incarnation > INCARNATIONS_MAX:
        return
    draws = KeyedDraws(seed, _SUBJECT)
    twice = said + said
    late = [i + draws.unit() * _LATE for i in range(len(twice))]
    shuffled = [twice[i] for i in sorted(range(len(twice)), key=late.__getitem__)]
    one, other = (_learned(scenario, incarnation, order) for order in (said, shuffled))
    if one.config.ledger and not np.array_equal(one.store.length, other.store.length):
        yield "join: logs have other lengths when they are learned in another order"
    elif not np.array_equal(one.weights, other.weights):
        yield "join: weights are others when messages are learned in another order, and twice"


def _said(scenario: Scenario, records: Iterable[Record]) -> Iterable[_Said]:
    places = {name: i for i, name in enumerate(scenario.roster)}
    for record in records:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            for envelope in step_record.outputs.outbox if step_record.outputs else ():
                news = decode_gossip(envelope.body)
                yield _Said(places[step_record.name] + news.incarnation * len(places), news)


def _learned(scenario: Scenario, incarnation: int, said: Sequence[_Said]) -> Replica:
    """Somebody who has learned it all."""
    samples = scenario.samples.count or 0
    units = Units.of(scenario.energy.points, samples)
    replica = build_replica(scenario.roster[0], scenario, units, samples, incarnation)
    before = -1
    for _ in range(_PASSES):
        for slot, news in said:
            replica.merge(slot, news.version_vector, news.logs, news.claims, news.registers)
        replica.end_step()
        held = int(replica.store.length.sum())
        if held == before:
            break
        before = held
    return replica
