"""The tally of a run: counters that every batch changes, in one compiled pass."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import State
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record import columnar as of

# Slots of RunTally.counts and RunTally.shipped.
VIOLATIONS, STEPS, BYTES_WEIGHTS, BYTES_TOTAL, ENERGY, UNITS = 0, 1, 2, 3, 4, 5


DELIVERIES, DROPS, FIRST_CONTACT, LEAST, REFUSED_BEFORE = 6, 7, 8, 9, 10


_EVER, NOW = 0, 1


NEVER = -1


class RunTally(NamedTuple):
    """Counters over batches. n participants, of them m robots; N samples."""

    counts: npt.NDArray[np.int64]
    """(11,): violations, robot-steps, bytes on weights keys and in all, points and units shipped,
    deliveries, drops, step of the first contact or NEVER, units in `least`, messages that
    former incarnations refused."""
    shipped: npt.NDArray[np.float64]
    """(2,) mass times metres: since the start, in this tick."""
    standing: npt.NDArray[np.int64]
    """(n, 5): refused messages; whether it rests; step in which it saw no weight left, or NEVER; how far
    its clock was ahead in its last step; whether the scenario has it lie."""
    shipped_by: npt.NDArray[np.float64]
    """(m,) since the start."""
    xy_m: npt.NDArray[np.float64]
    """(m, 2) where robots are, world frame."""
    views: npt.NDArray[np.int64]
    """(n, N) the weight vector of each, in units."""
    least: npt.NDArray[np.int64]
    """(N,) the least of all views."""
    true_left: npt.NDArray[np.int64]
    """(N,) first weight minus all spending; negative where a sample was filled twice."""


@kernel
def _lower(tally: RunTally, place: int, sample: int, left: int) -> None:
    """Put an entry into a view. A record that is not sound may let it rise."""
    before, least = tally.views[place, sample], tally.least[sample]
    tally.views[place, sample] = left
    lower = min(left, least)
    if left > before == least:
        lower = left
        for other in range(tally.views.shape[0]):
            lower = min(lower, tally.views[other, sample])
    tally.least[sample] = lower
    tally.counts[LEAST] += lower - least


@kernel
def begin_anew(
    counts: np.ndarray,
    shipped: np.ndarray,
    standing: np.ndarray,
    shipped_by: np.ndarray,
    xy_m: np.ndarray,
    views: np.ndarray,
    least: np.ndarray,
    true_left: np.ndarray,
    place: int,
    units: int,
) -> None:
    """A new incarnation drives a body: its view is full, it does not rest, it has refused nothing."""
    tally = RunTally(counts, shipped, standing, shipped_by, xy_m, views, least, true_left)
    counts[REFUSED_BEFORE] += standing[place, 0]
    standing[place, 0], standing[place, 1], standing[place, 2] = 0, 0, NEVER
    for sample in range(least.shape[0]):
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
    _payload: bytes,
    sizes: np.ndarray,
    step_records: np.ndarray,
    poses_m: np.ndarray,
    _heard: np.ndarray,
    _sent: np.ndarray,
    decisions: np.ndarray,
    pairs: np.ndarray,
    _injected: np.ndarray,
    counts: np.ndarray,
    shipped: np.ndarray,
    standing: np.ndarray,
    shipped_by: np.ndarray,
    xy_m: np.ndarray,
    views: np.ndarray,
    least: np.ndarray,
    true_left: np.ndarray,
    samples_m: np.ndarray,
    whole: int,
) -> int:
    """Count one batch, see ColumnarBatch and RunTally; the number of targets found in it.

    samples_m: (N, 2) as they are now.
    """
    tally = RunTally(counts, shipped, standing, shipped_by, xy_m, views, least, true_left)
    finds = 0
    for row in range(sizes[of.DECISIONS]):
        counts[DROPS if decisions[row, of.DUE_NS] == DROPPED else DELIVERIES] += 1
    for row in range(sizes[of.STEP_RECORDS]):
        step_record = step_records[row]
        place = step_record[of.PLACE]
        if place < 0 or not step_record[of.PRESENT]:
            continue
        counts[VIOLATIONS] += step_record[of.VIOLATIONS]
        if step_record[of.TOO_FAST] > 0 and (
            standing[place, 4] or step_record[of.SKEW_NS] > standing[place, 3]
        ):  # as in the rule `ruling` of the checker
            counts[VIOLATIONS] -= 1
        standing[place, 3] = step_record[of.SKEW_NS]
        standing[place, 0] = step_record[of.REFUSED]
        for i in range(
            step_record[of.LOWERED], step_record[of.LOWERED] + max(0, step_record[of.LOWERED_COUNT])
        ):
            _lower(tally, place, pairs[i, of.SAMPLE], pairs[i, of.UNITS])
        if place >= xy_m.shape[0]:  # the supervisor
            continue
        xy_m[place, 0], xy_m[place, 1] = poses_m[row, 0], poses_m[row, 1]
        counts[STEPS] += 1
        counts[BYTES_WEIGHTS] += step_record[of.WEIGHTS_BYTES]
        counts[BYTES_TOTAL] += step_record[of.WEIGHTS_BYTES] + step_record[of.BODY_BYTES]
        finds += step_record[of.FINDS]
        if step_record[of.HEARD_COUNT] > 0 and counts[FIRST_CONTACT] == NEVER:
            counts[FIRST_CONTACT] = step_record[of.STEP]
        if step_record[of.STATE] != State.EXPLORING.value:
            standing[place, 1] = 1
        if step_record[of.STATE] == State.FINISHED.value and standing[place, 2] == NEVER:
            standing[place, 2] = step_record[of.STEP]
        if step_record[of.SPENT_COUNT] > 0 and not step_record[of.UNSHIPPED]:
            counts[ENERGY] += 1
            for i in range(
                step_record[of.SPENT], step_record[of.SPENT] + step_record[of.SPENT_COUNT]
            ):
                _ship(tally, samples_m, place, pairs[i, of.SAMPLE], pairs[i, of.UNITS], whole)
    return finds
