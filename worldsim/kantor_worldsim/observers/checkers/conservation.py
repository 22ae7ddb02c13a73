"""Rules on weight: energy is spent once, and nothing is lost or counted twice."""

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_uint
from kantor_worldsim.observers.checkers.state import (
    KEYFRAMES,
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.observers.checkers.violations import (
    BELOW,
    BUDGET,
    GARBLED_LOWERED,
    GARBLED_SPENT,
    MISCOUNT,
    NO_SAMPLE,
    NO_WEIGHT,
    NOT_ITS_OWN,
    NOT_REBUILT,
    POINT,
    RISE,
)
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch


@kernel
def check_energy(state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int) -> None:
    """A step spends units that are left, one point at a time, within the budget."""
    step_record = columns.step_records[row]
    who = step_record.place
    participant = state.participants[who]
    incarnation_id = participant.incarnation_id
    if step_record.spent_count == of.NOT_DECODED:
        note_violation(state, GARBLED_SPENT, row, 0, 0, 0, 0.0, 0.0)
        return
    shipped = 0
    for i in range(step_record.spent, step_record.spent + step_record.spent_count):
        sample, units = columns.pairs[i].sample, columns.pairs[i].units
        shipped += units
        state.consumed[sample] += units
        if limits.ledger:
            entry = state.logs[incarnation_id, state.shipped[incarnation_id].entries]
            entry.sample, entry.units = sample, units
            state.shipped[incarnation_id].entries += 1
    state.shipped[incarnation_id].writes += step_record.spent_count > 0
    participant.points += step_record.spent_count > 0
    points = participant.points
    if shipped > limits.point_units:
        note_violation(state, POINT, row, 0, shipped, 0, 0.0, 0.0)
    if points > limits.budget:
        note_violation(state, BUDGET, row, 0, points, 0, 0.0, 0.0)
    if step_record.energy < points and who != limits.supervisor:
        note_violation(state, MISCOUNT, row, 0, step_record.energy, points, 0.0, 0.0)


@kernel
def check_weights(state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int) -> None:
    """Weights only fall, and by what was spent or merged."""
    step_record = columns.step_records[row]
    participant, view = (
        state.participants[step_record.place],
        state.views[step_record.place],
    )
    if step_record.lowered_count == of.NOT_DECODED:
        note_violation(state, GARBLED_LOWERED, row, 0, 0, 0, 0.0, 0.0)
    for i in range(step_record.lowered, step_record.lowered + max(0, step_record.lowered_count)):
        sample, left = columns.pairs[i].sample, columns.pairs[i].units
        if left >= view[sample]:
            note_violation(state, RISE, row, sample, view[sample], left, 0.0, 0.0)
        if not limits.false_logs and left < limits.sample_units - state.consumed[sample]:
            note_violation(state, BELOW, row, sample, 0, 0, 0.0, 0.0)
        published = state.published[step_record.place, sample]
        participant.differing += (published != left) - (published != view[sample])
        view[sample] = left


@kernel
def check_published(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """A published difference rebuilds the vector; a keyframe is left to `Checker`, which inflates it."""
    step_record = columns.step_records[row]
    payload, at = columns.payload, step_record.weights
    participant, view = (
        state.participants[step_record.place],
        state.views[step_record.place],
    )
    published = state.published[step_record.place]
    sequence, base, size, at, end = of.parts_of_weights(payload, at, at + step_record.weights_bytes)
    if end >= 0 and base == 0:
        participant.sequence, participant.keyframe = sequence, row + 1
        state.counts[KEYFRAMES] += 1
        return
    sound = end >= 0 and base == participant.sequence and size == view.shape[0]
    sample = 0
    while sound and at < end:
        step, at = read_int(payload, at)
        units, at = read_uint(payload, at)
        sample += step
        if not (0 <= at <= end and 0 <= sample < size) or units > published[sample]:
            sound = False
            break
        left = view[sample]
        participant.differing += (units != left) - (published[sample] != left)
        published[sample] = units
    if end >= 0:
        participant.sequence = sequence if sound else 0
    if not sound:
        note_violation(state, NOT_REBUILT, row, 0, 0, 0, 0.0, 0.0)
    elif participant.differing:
        note_violation(state, NOT_ITS_OWN, row, 0, 0, 0, 0.0, 0.0)


@kernel
def check_goal(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """The weight at the time of choosing: what is left now, or what it has shipped since."""
    samples_m, by_x = state.samples_m, state.by_x
    x_m, y_m = columns.poses_m[row, 2], columns.poses_m[row, 3]
    low, high = 0, by_x.shape[0]
    while low < high:
        middle = (low + high) // 2
        if samples_m[by_x[middle], 0] < x_m:
            low = middle + 1
        else:
            high = middle
    known = False
    while low < by_x.shape[0] and samples_m[by_x[low], 0] == x_m:
        sample = by_x[low]
        if samples_m[sample, 1] == y_m:
            known = True
            if state.views[columns.step_records[row].place, sample] > 0:
                return
        low += 1
    if not known:
        note_violation(state, NO_SAMPLE, row, 0, 0, 0, 0.0, 0.0)
    elif not ships_to(state, columns, row, x_m, y_m):
        note_violation(state, NO_WEIGHT, row, 0, 0, 0, 0.0, 0.0)


@kernel
def ships_to(state: CheckerState, columns: ColumnarBatch, row: int, x_m: float, y_m: float) -> bool:
    """Whether units of this step were shipped to a place."""
    step_record = columns.step_records[row]
    for i in range(step_record.spent, step_record.spent + max(0, step_record.spent_count)):
        place_m = state.samples_m[columns.pairs[i].sample]
        if place_m[0] == x_m and place_m[1] == y_m and columns.pairs[i].units > 0:
            return True
    return False
