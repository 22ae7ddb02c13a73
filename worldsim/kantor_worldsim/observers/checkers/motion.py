"""Rules on steps: which participant may step, what world-sim accepts of it, and how fast a robot moves."""

import math

from kantor_protocol.base.kernels import kernel
from kantor_worldsim.observers.checkers.state import (
    FORGED_FIRST,
    NOT_STOPPED,
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.observers.checkers.violations import (
    REFUSALS,
    REFUSED,
    SKEW,
    SPEED,
    STALE,
    STEP,
    STOPPED,
)
from kantor_worldsim.record.columnar import ColumnarBatch

_ROUNDING = 2e-6
"""By so much of the limit a move may be longer, for rounding."""
_COORDINATES = 2.0**-49
"""And by so much of the coordinates, since a pose is rounded where it is; none where nothing may move."""


@kernel
def check_running(state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int) -> None:
    """Only a participant that runs acts, and its clock is wrong only by a fault."""
    step_record = columns.step_records[row]
    stopped_ns = state.participants[step_record.place].stopped_ns
    if stopped_ns != NOT_STOPPED and (
        limits.virtual or step_record.now_ns > stopped_ns + limits.signal_slack_ns
    ):
        note_violation(state, STOPPED, row, 0, 0, 0, stopped_ns * 1e-9, 0.0)
    if step_record.skew_ns != 0 and not limits.clocks:
        note_violation(state, SKEW, row, 0, step_record.skew_ns, 0, 0.0, 0.0)


@kernel
def check_verdict(state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int) -> None:
    """World-sim refuses nothing, but the speed of a robot whose clock has gained on time since its last step."""
    step_record = columns.step_records[row]
    participant = state.participants[step_record.place]
    excused = limits.clocks and step_record.skew_ns > participant.skew_before_ns
    participant.skew_before_ns = step_record.skew_ns
    for item in range(step_record.violations):
        if not (excused and item + 1 == step_record.too_fast):
            note_violation(state, REFUSED, row, item, 0, 0, 0.0, 0.0)


@kernel
def check_order(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """Steps are numbered without gaps, and made with the newest observation."""
    step_record = columns.step_records[row]
    participant = state.participants[step_record.place]
    if step_record.step != participant.steps + 1:
        note_violation(state, STEP, row, 0, step_record.step, participant.steps + 1, 0.0, 0.0)
    elif step_record.observed != participant.steps:
        note_violation(state, STALE, row, 0, step_record.step, step_record.observed, 0.0, 0.0)
    participant.steps = step_record.step


@kernel
def check_refusals(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """A participant refuses what is forged, and nothing else but what liars say."""
    step_record = columns.step_records[row]
    participant = state.participants[step_record.place]
    forged, of_liars = 0, 0
    for item in range(step_record.heard, step_record.heard + step_record.heard_count):
        source = columns.heard[item].source
        if columns.heard[item].sequence >= FORGED_FIRST:
            forged += 1
        elif source >= 0:
            of_liars += state.participants[source].lies
    refused = step_record.refused - participant.refusals_so_far
    if not forged <= refused <= forged + of_liars:
        note_violation(state, REFUSALS, row, 0, refused, forged, 0.0, 0.0)
    participant.refusals_so_far = step_record.refused


@kernel
def check_speed(state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int) -> None:
    """A participant moves no farther than its speed allows since its last step."""
    step_record = columns.step_records[row]
    who = step_record.place
    elapsed_ns = step_record.now_ns - state.participants[who].moved_ns
    limit_m_s = 0.0 if who == limits.supervisor else limits.speed_m_s
    limit_m = limit_m_s * elapsed_ns * 1e-9 * (1.0 + _ROUNDING)
    x_m, y_m = columns.poses_m[row, 0], columns.poses_m[row, 1]
    if limit_m > 0.0:
        limit_m += _COORDINATES * max(abs(state.poses_m[who, 0]), abs(state.poses_m[who, 1]))
    way_m = math.hypot(x_m - state.poses_m[who, 0], y_m - state.poses_m[who, 1])
    if not way_m <= limit_m:
        note_violation(state, SPEED, row, 0, 0, 0, way_m, limit_m)
    state.participants[who].moved_ns = step_record.now_ns
    state.poses_m[who, 0], state.poses_m[who, 1] = x_m, y_m
