"""One compiled pass over a batch: every rule on numbers, step by step, in the order in which things happen."""

from typing import Any

from kantor_protocol.base.kernels import kernel
from kantor_worldsim.observers.checkers.conservation import (
    check_energy,
    check_goal,
    check_published,
    check_weights,
)
from kantor_worldsim.observers.checkers.delivery import (
    check_decision,
    check_inbox,
    post,
    post_forged,
)
from kantor_worldsim.observers.checkers.links import LinkTable
from kantor_worldsim.observers.checkers.motion import (
    check_order,
    check_refusals,
    check_running,
    check_speed,
    check_verdict,
)
from kantor_worldsim.observers.checkers.replication import check_gossip
from kantor_worldsim.observers.checkers.state import (
    KEYFRAMES,
    NOTED,
    CheckerState,
    Limits,
    missing_capacity,
    note_violation,
)
from kantor_worldsim.observers.checkers.violations import NOT_IN_ROSTER
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch


@kernel
def check_batch(
    batch: tuple[Any, ...],
    so_far: tuple[Any, ...],
    limiting: tuple[Any, ...],
    linking: tuple[Any, ...],
    now_ns: int,
) -> int:
    """Check one batch; the number of violations and keyframes in it.

    Takes the fields of a ColumnarBatch, a CheckerState, Limits and a LinkTable. Less than 0 if a table has
    too little room, see `missing_capacity`; then nothing has changed.
    """
    columns, state = ColumnarBatch(*batch), CheckerState(*so_far)
    limits, links = Limits(*limiting), LinkTable(*linking)
    sizes, counts = columns.sizes, state.counts
    missing = missing_capacity(state, columns)
    if missing < 0:
        return missing
    counts[NOTED], counts[KEYFRAMES] = 0, 0
    for row in range(sizes[of.STEP_RECORDS]):
        if columns.step_records[row].place >= 0:
            check_inbox(state, limits, columns, row, now_ns)
            post(state, columns, row)
    post_forged(state, columns)
    for row in range(sizes[of.DECISIONS]):
        check_decision(state, links, columns, row)
    for row in range(sizes[of.STEP_RECORDS]):
        step_record = columns.step_records[row]
        if step_record.place < 0:
            note_violation(state, NOT_IN_ROSTER, row, 0, 0, 0, 0.0, 0.0)
        elif step_record.present:
            check_step(state, limits, columns, row)
    return counts[NOTED] + counts[KEYFRAMES]


@kernel
def check_step(state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int) -> None:
    """Check what a participant did in one step, and what world-sim made of it."""
    step_record = columns.step_records[row]
    check_running(state, limits, columns, row)
    check_order(state, columns, row)
    check_refusals(state, columns, row)
    check_speed(state, limits, columns, row)
    check_energy(state, limits, columns, row)
    check_weights(state, limits, columns, row)
    for item in range(step_record.sent_count):
        check_gossip(state, limits, columns, row, item)
    check_verdict(state, limits, columns, row)
    if step_record.weights_bytes:
        check_published(state, columns, row)
    if limits.transport and step_record.heads:
        check_goal(state, columns, row)
