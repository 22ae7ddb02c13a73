"""Rules on weight and energy: weights only fall, are published as they are, and energy is spent once."""

import zlib
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from kantor_protocol.wire.weights import WeightsMessage, WeightsSubscriber
from kantor_worldsim.record.records import Record
from support.broken_records import BrokenRecord, BrokenRecords, outputs, put_step, with_scenario
from support.records import Play, Records, consumed, entries, opening, pairs, step_records
from support.variants import DISK_LOST, MERGES, OUT_OF_RANGE

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


# The weight vector of a participant.


@breaks("weights", run=MERGES["min"])
def _weight_rises(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]
    spent_first = entries(step_records(records, "r1")[0].outputs.lowered)[0][0]
    return put_step(records, last, outputs(lowered=pairs((spent_first, 3))))


@breaks("weights", run=MERGES["min"])
def _weight_falls_to_what_it_was(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    lowered = entries(step_record.outputs.lowered)
    return put_step(records, step_record, outputs(lowered=pairs(*lowered, lowered[0])))


@breaks("weights", run=(*MERGES["min"], *OUT_OF_RANGE))
def _lowered_weights_do_not_decode(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[-1], outputs(lowered=b"\x80"))


# What it publishes of it.


@breaks("weights", run=MERGES["min"])
def _published_vector_is_not_the_robots(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[10]
    message = msgspec.msgpack.decode(step_record.outputs.weights, type=WeightsMessage)
    assert message.base > 0
    unchanged = msgspec.structs.replace(message, content=b"")
    return put_step(records, step_record, outputs(weights=msgspec.msgpack.encode(unchanged)))


@breaks("weights", run=MERGES["min"])
def _published_vector_cannot_be_rebuilt(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[10]
    return put_step(records, step_record, outputs(weights=step_record.outputs.weights[:-1]))


def republished(records: Records, which: int, **values: Any) -> list[Record]:
    """Other values in the weights message that the first robot published in one of its steps."""
    step_record = step_records(records, "r1")[which]
    message = msgspec.msgpack.decode(step_record.outputs.weights, type=WeightsMessage)
    assert (message.base == 0) == (which == 0)
    other = msgspec.structs.replace(message, **values)
    return put_step(records, step_record, outputs(weights=msgspec.msgpack.encode(other)))


@breaks("weights", run=MERGES["min"])
def _keyframe_is_not_the_robots(records: Records) -> list[Record]:
    samples = opening(records).samples_m.shape[0]
    return republished(records, 0, content=zlib.compress(bytes(samples)))


@breaks("weights", run=MERGES["min"])
def _keyframe_does_not_inflate(records: Records) -> list[Record]:
    return republished(records, 0, content=b"?")


@breaks("weights", run=MERGES["min"])
def _keyframe_of_another_size(records: Records) -> list[Record]:
    return republished(records, 0, content=zlib.compress(bytes(3)), size=3)


@breaks("weights", run=MERGES["min"])
def _changes_of_another_base(records: Records) -> list[Record]:
    return republished(records, 10, base=7)


@breaks("weights", run=MERGES["min"])
def _changes_that_rise(records: Records) -> list[Record]:
    return republished(records, 10, content=pairs((0, 1_000_000)))


@breaks("weights", run=MERGES["min"])
def _changes_beyond_the_last_sample(records: Records) -> list[Record]:
    return republished(records, 10, content=pairs((opening(records).samples_m.shape[0], 0)))


@breaks("weights", run=DISK_LOST)
def _new_incarnation_begins_with_changes(records: Records) -> list[Record]:
    publishing = [
        step_record
        for step_record in step_records(records, "r2")
        if step_record.outputs and step_record.outputs.weights
    ]
    first = next(step_record for step_record in publishing if step_record.now_ns >= 1_100_000_000)
    message = msgspec.msgpack.decode(first.outputs.weights)
    message[3] = 1  # the base: changes of an earlier vector, not a keyframe
    return put_step(records, first, outputs(weights=msgspec.msgpack.encode(message)))


def test_subscriber_sees_what_the_checker_follows(played: Play) -> None:
    """What observers rebuild from the weights key is what the robots hold at the end."""
    for merge in MERGES.values():
        records = played(*merge)
        for name in ("r1", "r2", "r3"):
            subscriber = WeightsSubscriber()
            view = np.full(60, opening(records).units.sample)
            for step_record in step_records(records, name):
                for sample, left in entries(step_record.outputs.lowered):
                    view[sample] = left
                if step_record.outputs.weights:
                    assert subscriber.apply(step_record.outputs.weights)

            assert subscriber.weights is not None
            assert view.tolist() == subscriber.weights.tolist()


# Energy.


@breaks("energy")
def _budget_is_smaller(records: Records) -> list[Record]:
    return with_scenario(records, energy={"steps": 20})


@breaks("energy", run=MERGES["min"])
def _point_holds_more_than_it_can(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    (sample, units), *rest = entries(step_record.outputs.spent)
    return put_step(records, step_record, outputs(spent=pairs((sample, units + 1), *rest)))


@breaks("energy")
def _counts_less_than_it_shipped(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[3], outputs(energy_spent=3))


@breaks("energy", "credit", run=MERGES["min"])
def _spending_does_not_decode(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[3], outputs(spent=b"\x80"))


OTHERS_LATE = (
    DISK_LOST[0].replace("}]", "}, {kind = 'late', who = ['r1', 'r3'], until_s = 1.5}]"),
)


@breaks("energy", run=OTHERS_LATE)
def _budget_is_for_all_incarnations(records: Records) -> list[Record]:
    spent = {
        name: [
            bool(step_record.outputs.spent)
            for step_record in step_records(records, name)
            if step_record.outputs is not None
        ]
        for name in ("r1", "r2", "r3")
    }
    both = sum(spent["r2"])
    assert both > max(sum(spent["r1"]), sum(spent["r3"]))
    return with_scenario(records, energy={"steps": both - 1})


# Views against the truth.


@breaks("credit", "weights", run=(*MERGES["min"], *OUT_OF_RANGE, "energy.steps=10"))
def _view_falls_below_the_truth(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]
    untouched = int(np.argmin(consumed(records, last.now_ns)))
    return put_step(records, last, outputs(lowered=pairs((untouched, 0))))


@breaks("credit", run=MERGES["min"])
def _view_falls_before_the_truth_does(records: Records) -> list[Record]:
    """r1 lowers a sample one step before another robot consumes it, which ends in the same views."""
    for early, late in pairwise(step_records(records, "r1")):
        before, lowered = entries(early.outputs.lowered), entries(late.outputs.lowered)
        truth = opening(records).units.sample - consumed(records, early.now_ns - 1)
        ahead = [(sample, left) for sample, left in lowered if left < truth[sample]]
        own = {sample for sample, _ in [*before, *entries(late.outputs.spent)]}
        if ahead and ahead[0][0] not in own:
            later = [entry for entry in lowered if entry != ahead[0]]
            sooner = put_step(records, early, outputs(lowered=pairs(*before, ahead[0])))
            return put_step(sooner, late, outputs(lowered=pairs(*later)))
    raise AssertionError("r1 never learns anything")


# Goals.


@breaks("goal")
def _goal_is_no_sample(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[3], outputs(goal=(1.0, 2.0)))


@breaks("goal")
def _goal_has_no_weight_left(records: Records) -> list[Record]:
    steps = step_records(records, "r1")
    empty = next(
        sample
        for step_record in steps
        for sample, left in entries(step_record.outputs.lowered)
        if left == 0
    )
    place = opening(records).setup.samples_m[empty].tolist()
    return put_step(records, steps[-2], outputs(goal=tuple(place)))


@breaks("goal", run=MERGES["min"])
def _goal_was_emptied_by_gossip(records: Records) -> list[Record]:
    places_m = opening(records).setup.samples_m.tolist()
    for step_record in step_records(records, "r1"):
        shipped = {sample for sample, _ in entries(step_record.outputs.spent)}
        for sample, left in entries(step_record.outputs.lowered):
            if left == 0 and sample not in shipped and step_record.outputs.goal is not None:
                return put_step(records, step_record, outputs(goal=tuple(places_m[sample])))
    raise AssertionError("no gossip empties a sample")


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
