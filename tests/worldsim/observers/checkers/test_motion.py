"""Rules on steps: they are numbered, follow the verdict on the last one, and move no farther than the speed allows."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_protocol.base.machine import SUPERVISOR, Pose
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.record.records import Record
from support.broken_records import (
    BrokenRecord,
    BrokenRecords,
    fields,
    outputs,
    put,
    put_step,
    verdict,
    with_scenario,
)
from support.checkers import rules
from support.records import Play, Records, batches, step_records
from support.variants import CLOCK_WRONG, OUT_OF_RANGE

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


# Speed.


@breaks("speed")
def _jumps(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    pose = step_record.verdict.pose
    return put_step(records, step_record, verdict(pose=Pose(pose.x_m + 30.0, pose.y_m)))


@breaks("speed", run=("coordination=centralized",))
def _supervisor_moves(records: Records) -> list[Record]:
    step_record = step_records(records, SUPERVISOR)[-1]
    return put_step(records, step_record, verdict(pose=Pose(50.0, 50.1)))


@breaks("speed")
def _pose_is_not_a_number(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[-1], verdict(pose=Pose(float("nan"), 0.0)))


@breaks("speed")
def _vehicle_is_slower(records: Records) -> list[Record]:
    return with_scenario(records, vehicle={"speed_m_s": 50.0})


def test_violation_has_rule_time_participant_and_text(played: Play) -> None:
    """A violation is one line: rule, time, participant, text."""
    records = _jumps(played(*OUT_OF_RANGE))

    assert check(records).violations[0].startswith("speed: t=0.400 s: r1: moved ")


# Step numbers.


@breaks("order")
def _step_is_left_out(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    return put_step(records, step_record, outputs(step=step_record.outputs.step + 1))


@breaks("order")
def _step_is_repeated(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    return put_step(records, step_record, outputs(step=step_record.outputs.step - 1))


@breaks("order")
def _unknown_participant_steps(records: Records) -> list[Record]:
    first = batches(records)[0]
    unknown = msgspec.structs.replace(first.step_records[0], name="r9")
    steps = (*first.step_records, unknown)
    return put(records, first, msgspec.structs.replace(first, step_records=steps))


@breaks("hold")
def _steps_without_the_verdict_on_its_last_step(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    stale = msgspec.structs.replace(step_record.observation, step=step_record.observation.step - 1)
    return put_step(records, step_record, fields(observation=stale))


# Step verdicts.


@breaks("ruling")
def _world_sim_refused_a_move(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[3], verdict(violations=("speed",)))


@breaks("ruling", run=CLOCK_WRONG)
def _too_fast_by_a_clock_that_did_not_gain(records: Records) -> list[Record]:
    step_record = next(
        step_record for step_record in reversed(step_records(records, "r2")) if step_record.skew_ns
    )
    return put_step(records, step_record, verdict(violations=("speed",)))


def test_too_fast_by_a_clock_that_gains_is_excused(played: Play) -> None:
    """A robot cannot know that its clock has jumped: world-sim refuses the move, and no rule is broken."""
    records = played(*CLOCK_WRONG)
    step_record = next(
        step_record for step_record in step_records(records, "r2") if step_record.skew_ns
    )

    assert rules(put_step(records, step_record, verdict(violations=("speed",)))) == set()
    assert rules(put_step(records, step_record, verdict(violations=("speed", "units")))) == {
        "ruling"
    }
    assert rules(put_step(records, step_record, verdict(violations=("units",)))) == {"ruling"}


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
