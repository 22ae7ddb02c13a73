"""Rules on steps: who may step, what the world made of it, and how fast a robot moves."""

import math

from kantor_protocol.base.kernels import kernel
from kantor_worldsim.observers.checkers.state import (
    FORGED_FIRST,
    MOVED_NS,
    NOT,
    REFUSALS,
    REFUSALS_SO_FAR,
    REFUSED,
    SKEW,
    SKEW_BEFORE_NS,
    SPEED,
    STALE,
    STEP,
    STEPS,
    STOPPED,
    STOPPED_NS,
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch
from kantor_worldsim.world.world import SPEED_TOLERANCE


@kernel
def check_incarnation(state: CheckerState, law: Limits, reading: ColumnarBatch, row: int) -> None:
    """Whether it can act at all, and by what clock."""
    act = reading.acts[row]
    stopped_ns = state.book[act[of.PLACE], STOPPED_NS]
    if stopped_ns != NOT and (law.virtual or act[of.NOW_NS] > stopped_ns + law.patience_ns):
        note_violation(state, STOPPED, row, 0, 0, 0, stopped_ns * 1e-9, 0.0)
    if act[of.SKEW_NS] != 0 and not law.clocks:
        note_violation(state, SKEW, row, 0, act[of.SKEW_NS], 0, 0.0, 0.0)


@kernel
def check_verdict(state: CheckerState, law: Limits, reading: ColumnarBatch, row: int) -> None:
    """Who is too fast since its clock has gained on time cannot know, and is not to blame."""
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    excused = law.clocks and act[of.SKEW_NS] > book[SKEW_BEFORE_NS]
    book[SKEW_BEFORE_NS] = act[of.SKEW_NS]
    for item in range(act[of.VIOLATIONS]):
        if not (excused and item + 1 == act[of.TOO_FAST]):
            note_violation(state, REFUSED, row, item, 0, 0, 0.0, 0.0)


@kernel
def check_order(state: CheckerState, reading: ColumnarBatch, row: int) -> None:
    """Steps are numbered without gaps, and made with the newest observation."""
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    if act[of.STEP] != book[STEPS] + 1:
        note_violation(state, STEP, row, 0, act[of.STEP], book[STEPS] + 1, 0.0, 0.0)
    elif act[of.OBSERVED] != book[STEPS]:
        note_violation(state, STALE, row, 0, act[of.STEP], act[of.OBSERVED], 0.0, 0.0)
    book[STEPS] = act[of.STEP]


@kernel
def check_refusals(state: CheckerState, reading: ColumnarBatch, row: int) -> None:
    """It refuses what is forged, and nothing else."""
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    forged = 0
    for item in range(act[of.HEARD], act[of.HEARD] + act[of.HEARD_COUNT]):
        forged += reading.heard[item, of.SEQUENCE] >= FORGED_FIRST
    refused = act[of.REFUSED] - book[REFUSALS_SO_FAR]
    if refused != forged:
        note_violation(state, REFUSALS, row, 0, refused, forged, 0.0, 0.0)
    book[REFUSALS_SO_FAR] = act[of.REFUSED]


@kernel
def check_speed(state: CheckerState, law: Limits, reading: ColumnarBatch, row: int) -> None:
    """A participant moves no farther than its speed allows since its last step."""
    act = reading.acts[row]
    who = act[of.PLACE]
    elapsed_ns = act[of.NOW_NS] - state.book[who, MOVED_NS]
    limit_m_s = 0.0 if who == law.supervisor else law.speed_m_s
    limit_m = limit_m_s * elapsed_ns * 1e-9 * (1.0 + 2.0 * SPEED_TOLERANCE)
    x_m, y_m = reading.poses_m[row, 0], reading.poses_m[row, 1]
    way_m = math.hypot(x_m - state.poses_m[who, 0], y_m - state.poses_m[who, 1])
    if not way_m <= limit_m:
        note_violation(state, SPEED, row, 0, 0, 0, way_m, limit_m)
    state.book[who, MOVED_NS] = act[of.NOW_NS]
    state.poses_m[who, 0], state.poses_m[who, 1] = x_m, y_m
