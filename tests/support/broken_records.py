"""Ways to change a record, and the registry of those that break a rule of the checker."""

from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.schedule import AnyFault
from kantor_protocol.wire.messages import decode_gossip, encode
from kantor_worldsim.radio.channel import DeliveryDecision
from kantor_worldsim.record.records import Batch, Record, StepRecord
from support.records import Records, opening
from support.variants import Overrides

# Changes of a step record.

Change = Callable[[StepRecord], StepRecord]


def fields(**values: Any) -> Change:
    """A change of some fields of a step record."""
    return lambda step_record: msgspec.structs.replace(step_record, **values)


def outputs(**values: Any) -> Change:
    """A change of some of what a participant returned."""
    return lambda step_record: msgspec.structs.replace(
        step_record, outputs=msgspec.structs.replace(step_record.outputs, **values)
    )


def verdict(**values: Any) -> Change:
    """A change of what world-sim made of a step."""
    return lambda step_record: msgspec.structs.replace(
        step_record, verdict=msgspec.structs.replace(step_record.verdict, **values)
    )


def heard(*references: tuple[ParticipantId, int]) -> Change:
    """A change of the inbox."""
    return fields(heard=references)


def gossip(step_record: StepRecord, **values: Any) -> Change:
    """A change of the one message that a participant sent in this step."""
    (envelope,) = step_record.outputs.outbox
    message = msgspec.structs.replace(decode_gossip(envelope.body), **values)
    return outputs(outbox=(msgspec.structs.replace(envelope, body=encode(message)),))


# Changes of a record.

LATE_NS = 1 << 60
"""A time after every end: what arrives then is missing in no inbox."""


def put(records: Records, old: Any, new: Any) -> list[Record]:
    """The records with one of them in place of another."""
    return [new if record is old else record for record in records]


def put_step(records: Records, old: StepRecord, change: Change) -> list[Record]:
    """The records with one step record changed."""

    def changed(batch: Batch) -> Batch:
        step_records = tuple(
            change(step_record) if step_record is old else step_record
            for step_record in batch.step_records
        )
        return msgspec.structs.replace(batch, step_records=step_records)

    return [changed(record) if isinstance(record, Batch) else record for record in records]


def add_decision(records: Records, batch: Batch, decision: DeliveryDecision) -> list[Record]:
    """The records with one more delivery decision of the radio."""
    decisions = (*batch.decisions, decision)
    return put(records, batch, msgspec.structs.replace(batch, decisions=decisions))


def with_scenario(records: Records, **tables: dict[str, Any]) -> list[Record]:
    """The records with other values in tables of the scenario in the opening."""
    first = opening(records)
    scenario = msgspec.structs.replace(
        first.scenario,
        **{
            key: msgspec.structs.replace(getattr(first.scenario, key), **values)
            for key, values in tables.items()
        },
    )
    return put(records, first, msgspec.structs.replace(first, scenario=scenario))


def with_faults(records: Records, *faults: AnyFault) -> list[Record]:
    """The records with other faults in the opening."""
    first = opening(records)
    scenario = msgspec.structs.replace(first.scenario, faults=faults)
    return put(records, first, msgspec.structs.replace(first, scenario=scenario))


# The registry.

Break = Callable[[Records], list[Record]]


class BrokenRecord(NamedTuple):
    """A way to break the record of a run."""

    run: Overrides
    """Overrides of the mission."""
    break_record: Break
    rules: set[str]
    """The rules that are broken, and no other."""


class BrokenRecords:
    """The broken records of one test file."""

    def __init__(self) -> None:
        self.cases: dict[str, BrokenRecord] = {}
        """By the first rule that is broken, and by the way to break it."""

    def breaks(self, *rules: str, run: Overrides = ()) -> Callable[[Break], Break]:
        """Register a way to break the record of a run, with the rules that it breaks."""

        def register(break_record: Break) -> Break:
            name = break_record.__name__.strip("_").replace("_", "-")
            self.cases[f"{rules[0]}-{name}"] = BrokenRecord(run, break_record, set(rules))
            return break_record

        return register

    def rules(self) -> set[str]:
        """The rules under which the cases are registered."""
        return {name.partition("-")[0] for name in self.cases}
