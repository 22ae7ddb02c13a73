"""The violations that kernels find: their numbers, rules and texts.

A kernel notes a violation as a row of numbers (`state.note_violation`). It is put into words afterwards, with the
record at hand: a sound run, which nearly every run is, then costs little more than reading it.
"""

from typing import Any

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.wire.messages import RefusedError, decode_gossip
from kantor_worldsim.record.records import Batch, StepRecord

VIOLATIONS_MAX = 100
"""Violations that are kept as texts; further ones are only counted."""

UNHEARD, NEVER_SENT, WRONG_TARGET, TOO_FAR = 0, 1, 2, 3
STEP, SPEED, GARBLED_SPENT, POINT, BUDGET, MISCOUNT = 4, 5, 6, 7, 8, 9
GARBLED_LOWERED, RISE, BELOW, UNREADABLE, LOG = 10, 11, 12, 13, 14
NOT_IN_ROSTER, REFUSED, NOT_REBUILT, NOT_ITS_OWN, NO_SAMPLE, NO_WEIGHT = 15, 16, 17, 18, 19, 20
WITHHELD, OUT_OF_ORDER, NUMBER_REUSED, STOPPED, STALE, REFUSALS = 21, 22, 23, 24, 25, 26
OTHER_INCARNATION, FOREIGN_LOG, FORGETS, NO_INCARNATION, SKEW, CUT = 27, 28, 29, 30, 31, 32

OF_DECISIONS = (NEVER_SENT, WRONG_TARGET, TOO_FAR, CUT)
"""Those that are about a delivery decision; the others are about a step record."""

TEXTS = {
    UNHEARD: ("delivery", "heard {what}, which was not delivered"),
    NEVER_SENT: ("delivery", "{what} was never sent"),
    WRONG_TARGET: ("delivery", "got {what}, which was sent to another target"),
    TOO_FAR: ("range", "{what} over {x:.6g} m, allowed {y:.6g} m"),
    CUT: ("cut", "{what} over a link that is cut"),
    STEP: ("order", "step {a}, expected {b}"),
    SPEED: ("speed", "moved {x:.6g} m, allowed {y:.6g} m"),
    GARBLED_SPENT: ("energy", "spending that does not decode"),
    POINT: ("energy", "{a} units in one point"),
    BUDGET: ("energy", "{a} points shipped"),
    MISCOUNT: ("energy", "counts {a} of {b} points"),
    GARBLED_LOWERED: ("weights", "entries that do not decode"),
    RISE: ("weights", "sample {item} from {a} to {b} units"),
    BELOW: ("credit", "its view of sample {item} is below the truth"),
    UNREADABLE: ("ledger", "sends a message that does not decode{what}"),
    LOG: ("ledger", "its log from {a} on is not what it consumed"),
    NOT_IN_ROSTER: ("order", "not in the roster"),
    REFUSED: ("ruling", "world-sim refused its {what}"),
    NOT_REBUILT: ("weights", "publishes a vector that cannot be rebuilt"),
    NOT_ITS_OWN: ("weights", "publishes a vector that is not its own"),
    NO_SAMPLE: ("goal", "{what} is no sample"),
    NO_WEIGHT: ("goal", "{what} has no weight left in its view"),
    WITHHELD: ("delivery", "did not hear {what}, which had arrived"),
    OUT_OF_ORDER: ("delivery", "heard {what} after messages that arrived later"),
    NUMBER_REUSED: ("delivery", "sends under number {a}, which it has used"),
    STOPPED: ("dead", "acts, and is stopped since {x:.3f} s"),
    STALE: ("hold", "makes step {a} after the verdict on step {b}"),
    REFUSALS: ("refusal", "refused {a} messages; {b} were forged"),
    OTHER_INCARNATION: ("epoch", "speaks as incarnation {a} and is {b}"),
    FOREIGN_LOG: ("ledger", "forwards an entry at {a} of {what}'s log that {what} never made"),
    FORGETS: ("ledger", "holds {a} entries of {what}'s log of which it held {b}"),
    NO_INCARNATION: ("ledger", "holds entries of {what}, an incarnation that never was"),
    SKEW: ("clock", "its clock is {a} ns ahead, which no fault causes"),
}
"""Rule and text of each. what: an envelope, an origin, or the codec's reason; x, y: lengths in metres, or a
time in seconds."""


def describe(
    batch: Batch, names: tuple[ParticipantId, ...], noted: tuple[Any, ...]
) -> tuple[str, ParticipantId, str]:
    """Rule, participant and text of a violation that a kernel has noted in a batch.

    noted: a row of `CheckerState.violations`.
    """
    kind, row, item, a, b, x_m, y_m = noted
    rule, text = TEXTS[kind]
    if kind in OF_DECISIONS:
        decision = batch.decisions[row]
        who, what = decision.target, f"{decision.source}#{decision.sequence}"
    else:
        who, what = batch.step_records[row].name, _subject(batch.step_records[row], names, noted)
    return rule, who, text.format(what=what, item=item, a=a, b=b, x=x_m, y=y_m)


def _subject(
    step_record: StepRecord, names: tuple[ParticipantId, ...], noted: tuple[Any, ...]
) -> str:
    """The envelope or origin that a violation in a step is about, or why the codec refuses a message."""
    kind, _, item, a, b, *_ = noted
    if kind in (UNHEARD, OUT_OF_ORDER):
        source, sequence = step_record.heard[item]
        return f"{source}#{sequence}"
    if kind == WITHHELD:
        return f"{names[a] if a >= 0 else 'a stranger'}#{b}"
    if kind in (FOREIGN_LOG, FORGETS, NO_INCARNATION):
        return origin_of(item, names)
    if kind == REFUSED and step_record.verdict is not None:
        return step_record.verdict.violations[item]
    if kind in (NO_SAMPLE, NO_WEIGHT) and step_record.outputs is not None:
        return str(step_record.outputs.goal)
    if kind == UNREADABLE and step_record.outputs is not None:
        try:
            decode_gossip(step_record.outputs.outbox[item].body)
        except RefusedError as error:
            return f": {error}"
    return ""


def origin_of(incarnation_id: int, names: tuple[ParticipantId, ...]) -> str:
    """The participant of an incarnation id, with the incarnation if it is not the first."""
    incarnation, place = divmod(incarnation_id, len(names))
    return f"{names[place]}:{incarnation}" if incarnation else names[place]
