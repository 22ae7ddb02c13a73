"""One compiled pass over a batch: every rule on numbers, step by step, in the order in which things happen."""

import numpy as np

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
    payload: bytes,
    sizes: np.ndarray,
    step_records: np.ndarray,
    verdicts_m: np.ndarray,
    heard: np.ndarray,
    sent: np.ndarray,
    decisions: np.ndarray,
    pairs: np.ndarray,
    injected: np.ndarray,
    participants: np.ndarray,
    poses_m: np.ndarray,
    views: np.ndarray,
    published: np.ndarray,
    consumed: np.ndarray,
    shipped: np.ndarray,
    logs: np.ndarray,
    posted: np.ndarray,
    deliveries: np.ndarray,
    delivery_slots: np.ndarray,
    forged: np.ndarray,
    version_vector: np.ndarray,
    violations: np.ndarray,
    lengths_m: np.ndarray,
    counts: np.ndarray,
    samples_m: np.ndarray,
    by_x: np.ndarray,
    sample_units: int,
    point_units: int,
    budget: int,
    ledger: bool,
    supervisor: int,
    speed_m_s: float,
    transport: bool,
    claims: bool,
    virtual: bool,
    clocks: bool,
    signal_slack_ns: int,
    false_logs: bool,
    cut: np.ndarray,
    range_m: np.ndarray,
    now_ns: int,
) -> int:
    """Check one batch; the number of violations and keyframes in it.

    Takes the fields of a ColumnarBatch, a CheckerState, Limits and a LinkTable. Less than 0 if an array has
    too little room, see `missing_capacity`; then nothing has changed.
    """
    columns = ColumnarBatch(
        payload, sizes, step_records, verdicts_m, heard, sent, decisions, pairs, injected
    )
    state = CheckerState(
        participants,
        poses_m,
        views,
        published,
        consumed,
        shipped,
        logs,
        posted,
        deliveries,
        delivery_slots,
        forged,
        version_vector,
        violations,
        lengths_m,
        counts,
        samples_m,
        by_x,
    )
    limits = Limits(
        sample_units,
        point_units,
        budget,
        ledger,
        supervisor,
        speed_m_s,
        transport,
        claims,
        virtual,
        clocks,
        signal_slack_ns,
        false_logs,
    )
    missing = missing_capacity(state, columns)
    if missing < 0:
        return missing
    counts[NOTED], counts[KEYFRAMES] = 0, 0
    for row in range(sizes[of.STEP_RECORDS]):
        if step_records[row, of.PLACE] >= 0:
            check_inbox(state, limits, columns, row, now_ns)
            post(state, columns, row)
    post_forged(state, columns)
    for row in range(sizes[of.DECISIONS]):
        check_decision(state, LinkTable(cut, range_m), columns, row)
    for row in range(sizes[of.STEP_RECORDS]):
        if step_records[row, of.PLACE] < 0:
            note_violation(state, NOT_IN_ROSTER, row, 0, 0, 0, 0.0, 0.0)
        elif step_records[row, of.PRESENT]:
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
    for item in range(step_record[of.SENT_COUNT]):
        check_gossip(state, limits, columns, row, item)
    check_verdict(state, limits, columns, row)
    if step_record[of.WEIGHTS_BYTES]:
        check_published(state, columns, row)
    if limits.transport and step_record[of.HEADS]:
        check_goal(state, columns, row)
