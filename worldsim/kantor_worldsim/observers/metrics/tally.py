"""The tally of a run: counters that every batch changes, in one compiled pass."""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import integers, kernel
from kantor_protocol.base.machine import State
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch

# Slots of RunTally.counts and RunTally.shipped.
VIOLATIONS, STEPS, BYTES_WEIGHTS, BYTES_TOTAL, ENERGY, UNITS = 0, 1, 2, 3, 4, 5


DELIVERIES, DROPS, FIRST_CONTACT, LEAST, REFUSED_BEFORE = 6, 7, 8, 9, 10


_EVER, NOW = 0, 1


NEVER = -1


STANDING = integers("refused", "rests", "finished_step", "skew_ns", "lies")
"""Refused messages; whether it rests; step in which it saw no weight left, or NEVER; how far its clock was ahead in its
last step; whether the scenario has it lie."""


class RunTally(NamedTuple):
    """Counters over batches. n participants, of them m robots; N samples."""

    counts: npt.NDArray[np.int64]
    """(11,): violations, robot-steps, bytes on weights keys and in all, points and units shipped,
    deliveries, drops, step of the first contact or NEVER, units in `least`, messages that
    former incarnations refused."""
    shipped: npt.NDArray[np.float64]
    """(2,) mass times metres: since the start, in this tick."""
    standing: npt.NDArray[Any]
    """(n,) of STANDING."""
    shipped_by: npt.NDArray[np.float64]
    """(m,) since the start."""
    xy_m: npt.NDArray[np.float64]
    """(m, 2) where robots are, world frame."""
    views: npt.NDArray[np.float64]
    """(n, N) the weight vector of each, in units: whole numbers, of which bounds are sums of products with metres."""
    least: npt.NDArray[np.int64]
    """(N,) the least of all views."""
    true_left: npt.NDArray[np.int64]
    """(N,) first weight minus all spending; negative where a sample was filled twice."""


@kernel
def _lower(tally: RunTally, place: int, sample: int, left: int) -> None:
    """Put an entry into a view. A record that is not sound may let it rise."""
    before, least = int(tally.views[place, sample]), tally.least[sample]
    tally.views[place, sample] = left
    lower = min(left, least)
    if left > before == least:
        lower = left
        for other in range(tally.views.shape[0]):
            lower = min(lower, int(tally.views[other, sample]))
    tally.least[sample] = lower
    tally.counts[LEAST] += lower - least


@kernel
def begin_anew(so_far: tuple[Any, ...], place: int, units: int) -> None:
    """A new incarnation drives a body: its view is full, it does not rest, it has refused nothing.

    so_far: the fields of a RunTally.
    """
    tally = RunTally(*so_far)
    standing = tally.standing[place]
    tally.counts[REFUSED_BEFORE] += standing.refused
    standing.refused, standing.rests, standing.finished_step = 0, 0, NEVER
    for sample in range(tally.least.shape[0]):
        _lower(tally, place, sample, units)


@kernel
def _ship(
    tally: RunTally, samples_m: np.ndarray, place: int, sample: int, units: int, whole: int
) -> None:
    dx = samples_m[sample, 0] - tally.xy_m[place, 0]
    dy = samples_m[sample, 1] - tally.xy_m[place, 1]
    cost = units * math.hypot(dx, dy) / whole
    tally.shipped[_EVER] += cost
    tally.shipped[NOW] += cost
    tally.shipped_by[place] += cost
    tally.counts[UNITS] += units
    tally.true_left[sample] -= units


@kernel
def follow(
    batch: tuple[Any, ...], so_far: tuple[Any, ...], samples_m: np.ndarray, whole: int
) -> int:
    """Count one batch; the number of targets found in it.

    batch, so_far: the fields of a ColumnarBatch and a RunTally. samples_m: (N, 2) as they are now.
    """
    columns, tally = ColumnarBatch(*batch), RunTally(*so_far)
    counts, pairs = tally.counts, columns.pairs
    finds = 0
    for row in range(columns.sizes[of.DECISIONS]):
        counts[DROPS if columns.decisions[row].due_ns == DROPPED else DELIVERIES] += 1
    for row in range(columns.sizes[of.STEP_RECORDS]):
        step_record = columns.step_records[row]
        place = step_record.place
        if place < 0 or not step_record.present:
            continue
        standing = tally.standing[place]
        counts[VIOLATIONS] += step_record.violations
        if step_record.too_fast > 0 and (
            standing.lies or step_record.skew_ns > standing.skew_ns
        ):  # as in the rule `ruling` of the checker
            counts[VIOLATIONS] -= 1
        standing.skew_ns = step_record.skew_ns
        standing.refused = step_record.refused
        for i in range(
            step_record.lowered, step_record.lowered + max(0, step_record.lowered_count)
        ):
            _lower(tally, place, pairs[i].sample, pairs[i].units)
        if place >= tally.xy_m.shape[0]:  # the supervisor
            continue
        tally.xy_m[place, 0] = columns.poses_m[row, 0]
        tally.xy_m[place, 1] = columns.poses_m[row, 1]
        counts[STEPS] += 1
        counts[BYTES_WEIGHTS] += step_record.weights_bytes
        counts[BYTES_TOTAL] += step_record.weights_bytes + step_record.body_bytes
        finds += step_record.finds
        if step_record.heard_count > 0 and counts[FIRST_CONTACT] == NEVER:
            counts[FIRST_CONTACT] = step_record.step
        if step_record.state != State.EXPLORING.value:
            standing.rests = 1
        if step_record.state == State.FINISHED.value and standing.finished_step == NEVER:
            standing.finished_step = step_record.step
        if step_record.spent_count > 0 and not step_record.unshipped:
            counts[ENERGY] += 1
            for i in range(step_record.spent, step_record.spent + step_record.spent_count):
                _ship(tally, samples_m, place, pairs[i].sample, pairs[i].units, whole)
    return finds
