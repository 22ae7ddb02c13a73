"""Truth, radio and record together: one moment of a mission at a time."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.machine import (
    EVERYBODY,
    Envelope,
    Inputs,
    Outputs,
    ParticipantId,
    Pose,
    State,
)
from kantor_protocol.wire.messages import BODY_BYTES_MAX
from kantor_worldsim.engine.simulation import Simulation, Step
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    EnvelopeIndex,
    Opening,
    Record,
    StepRecord,
    encode_record,
)
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.world import WorldSetup
from support.grounds import drawn, exploration
from support.strategies import mission

PERIOD_NS = 100_000_000
STARTS = {"r1": (0.0, 0.0), "r2": (24.0, 0.0), "r3": (90.0, 0.0)}


class Theatre:
    """A stage with a record, and robots whose steps are made by hand."""

    def __init__(self, *overrides: str) -> None:
        scenario = mission("sensor.range_m=5", *overrides)
        site = WorldSetup(
            np.zeros((12, 2)), np.array([[3.0, 0.0]]), np.array(list(STARTS.values()))
        )
        self.records: list[Record] = []
        self.simulation = Simulation(scenario, 1, site, [self.records.append])
        self.step = 0

    def play(self, **step_records: Outputs | None) -> Batch:
        """One period in which these participants act."""
        self.step += 1
        now_ns = self.step * PERIOD_NS
        given = {name: self.simulation.inputs(name, now_ns) for name in step_records}
        steps = [Step(name, given[name], outputs) for name, outputs in step_records.items()]
        self.simulation.settle(now_ns, steps)
        batch = self.records[-1]
        assert isinstance(batch, Batch)
        return batch


def outputs(
    step: int,
    place: tuple[float, float],
    *says: str,
    state: State = State.EXPLORING,
    source: str = "r1",
) -> Outputs:
    """A step to a place, with something said to each of these targets."""
    outbox = tuple(
        Envelope(source, 10 * step + i, target, b"hello") for i, target in enumerate(says)
    )
    return Outputs(step, Pose(*place), outbox=outbox, state=state)


def act_of(batch: Batch, name: ParticipantId) -> StepRecord:
    return next(step_record for step_record in batch.step_records if step_record.name == name)


def test_record_opens_with_all_that_the_run_starts_from() -> None:
    """Scenario, seed, points and the first look: what is needed to run it again."""
    theatre = Theatre()
    (opening,) = theatre.records

    assert isinstance(opening, Opening)
    assert opening.scenario == theatre.simulation.scenario
    assert opening.site.starts_m.tolist() == [list(place) for place in STARTS.values()]
    assert opening.first_look == {"r1": ((0, 3.0, 0.0),), "r2": (), "r3": ()}
    assert (opening.units.sample, opening.units.point) == (5, 2)


def test_everybody_is_heard_from_where_its_step_began() -> None:
    """Range is between the poses before the moves of a moment: who comes near is heard next time."""
    theatre = Theatre("radio.range_m=5")
    near = {"r1": (10.0, 0.0), "r2": (15.0, 0.0), "r3": (90.0, 0.0)}
    first, second = (
        theatre.play(**{name: outputs(step, near[name], EVERYBODY, source=name) for name in near})
        for step in (1, 2)
    )

    assert first.decisions == ()
    assert [(v.source, v.target) for v in second.decisions] == [("r1", "r2"), ("r2", "r1")]
    assert (first.out_of_range, second.out_of_range) == (6, 4)


def test_inbox_is_handed_out_once() -> None:
    """What has been given to a participant is not given to it again."""
    theatre = Theatre()
    theatre.play(r1=outputs(1, (0.0, 0.0), "r2", "r2"))
    first = theatre.simulation.inputs("r2", 2 * PERIOD_NS)

    assert [envelope.sequence for envelope in first.inbox] == [10, 11]
    assert theatre.simulation.inputs("r2", 2 * PERIOD_NS).inbox == ()


def test_act_is_recorded_with_what_led_to_it() -> None:
    """Time, observation, inbox by reference, outputs and ruling: a step can be repeated alone."""
    theatre = Theatre()
    first = theatre.play(r1=outputs(1, (0.0, 0.0), EVERYBODY))
    second = theatre.play(r2=outputs(1, (20.0, 0.0), source="r2"))
    step_record = act_of(second, "r2")
    mailbag = EnvelopeIndex()
    mailbag.add(first)

    assert step_record.heard == (("r1", 10),)
    assert (step_record.now_ns, step_record.observation.pose) == (2 * PERIOD_NS, Pose(24.0, 0.0))
    assert step_record.verdict is not None
    assert step_record.verdict.pose == Pose(20.0, 0.0)
    assert mailbag.inputs(step_record) == Inputs(
        2 * PERIOD_NS, step_record.observation, (Envelope("r1", 10, EVERYBODY, b"hello"),)
    )


def test_reference_to_what_was_never_sent_is_noticed() -> None:
    """An inbox that nobody filled cannot be rebuilt."""
    theatre = Theatre()
    theatre.play(r1=outputs(1, (0.0, 0.0), EVERYBODY))
    second = theatre.play(r2=outputs(1, (20.0, 0.0), source="r2"))

    with pytest.raises(KeyError):
        EnvelopeIndex().inputs(act_of(second, "r2"))


# What has no place on the stage.

UNSOUND: dict[str, Callable[[], Outputs | None]] = {
    "missing": lambda: None,
    "false-sender": lambda: outputs(1, (1.0, 0.0), EVERYBODY, source="r2"),
    "sender-in-part-false": lambda: Outputs(
        1,
        Pose(1.0, 0.0),
        outbox=(Envelope("r1", 1, EVERYBODY, b""), Envelope("r3", 1, EVERYBODY, b"")),
    ),
    "nowhere": lambda: outputs(1, (math.nan, 0.0), EVERYBODY),
    "infinitely-far": lambda: outputs(1, (0.0, math.inf), EVERYBODY),
    "no-heading": lambda: Outputs(1, Pose(1.0, 0.0, math.nan)),
    "goal-nowhere": lambda: Outputs(1, Pose(1.0, 0.0), goal=(0.0, math.nan)),
    "oversized": lambda: Outputs(
        1, Pose(1.0, 0.0), outbox=(Envelope("r1", 1, EVERYBODY, bytes(BODY_BYTES_MAX + 1)),)
    ),
}


@pytest.mark.parametrize("name", list(UNSOUND))
def test_unsound_outputs_are_as_if_missing(name: str) -> None:
    """Bad numbers, a false sender, nothing at all: recorded as absent, without effect on others."""
    theatre = Theatre()
    batch = theatre.play(r1=UNSOUND[name](), r2=outputs(1, (20.0, 0.0), "r1", source="r2"))
    absent, present = act_of(batch, "r1"), act_of(batch, "r2")

    assert batch.absent == ("r1",)
    assert (absent.outputs, absent.verdict) == (None, None)
    assert present.outputs is not None
    assert [(v.source, v.target) for v in batch.decisions] == [("r2", "r1")]
    assert theatre.simulation.inputs("r1", 2 * PERIOD_NS).observation.pose == Pose(0.0, 0.0)
    assert not theatre.simulation.acted("r1")
    assert theatre.simulation.acted("r2")


def test_turn_is_asked_again_until_it_is_answered() -> None:
    """The same inputs, whatever came since; the inbox is on record with the answer."""
    theatre = Theatre()
    theatre.play(r2=outputs(1, (20.0, 0.0), "r1", source="r2"))
    turn = theatre.simulation.request("r1", 2 * PERIOD_NS, skew_ns=7)
    theatre.simulation.settle(2 * PERIOD_NS, [turn])
    silent = theatre.records[-1]
    theatre.play(r2=outputs(2, (20.0, 0.0), "r1", source="r2"))
    again = theatre.simulation.request("r1", 4 * PERIOD_NS)
    theatre.simulation.settle(4 * PERIOD_NS, [again.answered(outputs(1, (1.0, 0.0)))])
    answered = theatre.records[-1]
    assert isinstance(silent, Batch)
    assert isinstance(answered, Batch)

    assert turn == again
    assert (silent.absent, answered.absent) == (("r1",), ())
    assert [act_of(batch, "r1").heard for batch in (silent, answered)] == [(), (("r2", 10),)]
    assert act_of(answered, "r1").now_ns == act_of(silent, "r1").now_ns == 2 * PERIOD_NS
    assert turn.inputs.now_ns == 2 * PERIOD_NS + 7
    assert theatre.simulation.unanswered("r1") is None


# The end.


def test_mission_is_done_when_everybody_rests() -> None:
    """Finished and exhausted robots rest; one that explores keeps the mission going."""
    theatre = Theatre()
    theatre.play(
        r1=outputs(1, (0.0, 0.0), state=State.FINISHED),
        r2=outputs(1, (24.0, 0.0), state=State.EXHAUSTED, source="r2"),
        r3=outputs(1, (90.0, 0.0), source="r3"),
    )
    before = theatre.simulation.over
    theatre.play(r3=outputs(2, (90.0, 0.0), state=State.FINISHED, source="r3"))

    assert (before, theatre.simulation.over) == (None, "done")


@pytest.mark.parametrize(
    ("resting", "gone", "over"),
    [
        ((), (), None),
        (("r1",), ("r2",), None),
        (("r1",), ("r2", "r3"), "done"),
        (("r1", "r2", "r3"), ("r2",), "done"),
        (("r1", "r2", "r3"), ("r1", "r2", "r3"), "done"),
        ((), ("r1", "r2", "r3"), "deserted"),
        (("r1",), ("r1", "r2", "r3"), "deserted"),
    ],
)
def test_those_who_left_are_not_waited_for(
    resting: tuple[str, ...], gone: tuple[str, ...], over: str | None
) -> None:
    """Done when all who are left rest; deserted when nobody is left and somebody had work."""
    theatre = Theatre()
    step_records = {
        name: outputs(1, STARTS[name], state=State.FINISHED, source=name) for name in resting
    }
    if step_records:
        theatre.play(**step_records)
    theatre.simulation._gone = set(gone)

    assert theatre.simulation.over == over


def test_supervisor_is_not_waited_for() -> None:
    """The mission is the robots': a supervisor that still sees weight does not keep it going."""
    theatre = Theatre("coordination=centralized")
    for name, place in STARTS.items():
        theatre.play(**{name: outputs(1, place, state=State.FINISHED, source=name)})

    assert theatre.simulation.over == "done"


def test_record_is_closed_with_the_reason() -> None:
    """The ending says when and why."""
    theatre = Theatre()
    theatre.play(r1=outputs(1, (0.0, 0.0)))
    theatre.simulation.end("interrupted")

    assert theatre.records[-1] == Ending(PERIOD_NS, "interrupted")


def test_time_of_the_stage_never_runs_back() -> None:
    """A step that is told late does not turn the clock of the mission back."""
    theatre = Theatre()
    theatre.play(r1=outputs(1, (0.0, 0.0)))
    late = theatre.simulation.inputs("r2", PERIOD_NS // 2)
    theatre.simulation.settle(
        PERIOD_NS // 2, [Step("r2", late, outputs(1, (24.0, 0.0), source="r2"))]
    )

    assert theatre.simulation.now_ns == PERIOD_NS


# On a map.


def explored(ground: Ground, *overrides: str) -> list[Record]:
    """The record of two robots that explore a map from its lower left."""
    scenario = exploration("robots.count=2", "sensor.range_m=3", "vehicle.speed_m_s=10", *overrides)
    starts_m = np.array([[1.5, 1.5], [2.5, 1.5]])
    records: list[Record] = []
    stopped = iter(range(200))
    site = WorldSetup(np.zeros((0, 2)), np.zeros((0, 2)), starts_m, ground)
    play(scenario, 1, site, [records.append], stopped=lambda: next(stopped, None) is None)
    return records


FLAT = drawn(
    "############",
    "#....#.....#",
    "#....#.....#",
    "#..........#",
    "#....#.....#",
    "#....#.....#",
    "############",
)


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("coordination=centralized",),
        ("sensor.noise_m=0.1", "radio.wall_loss_m=3.0", "radio.range_m=8"),
    ],
    ids=["decentralized", "centralized", "noisy"],
)
def test_mission_on_a_map_is_the_same_from_its_opening(overrides: tuple[str, ...]) -> None:
    """The opening holds all that a run starts from: played from there, every record is the same."""
    records = explored(FLAT, *overrides)
    opening = records[0]
    assert isinstance(opening, Opening)
    ground = opening.site.ground
    assert ground is not None
    again = explored(ground, *overrides)

    assert [encode_record(record) for record in again] == [encode_record(r) for r in records]


def test_robots_on_a_map_explore_it() -> None:
    """They see its walls and no others, hit none, and are done."""
    records = explored(FLAT)
    verdicts = [
        step_record.verdict
        for record in records
        if isinstance(record, Batch)
        for step_record in record.step_records
    ]
    ending = records[-1]

    assert isinstance(ending, Ending)
    assert ending.reason == "done"
    assert not any(verdict.violations or verdict.bumped for verdict in verdicts if verdict)
