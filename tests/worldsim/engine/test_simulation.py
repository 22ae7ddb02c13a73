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
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    EnvelopeIndex,
    Opening,
    ProcessEvent,
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


class ScriptedMission:
    """A simulation with a record, and robots whose steps the test makes."""

    def __init__(self, *overrides: str) -> None:
        scenario = mission("sensor.range_m=5", *overrides)
        setup = WorldSetup(
            np.zeros((12, 2)), np.array([[3.0, 0.0]]), np.array(list(STARTS.values()))
        )
        self.records: list[Record] = []
        self.simulation = Simulation(scenario, 1, setup, [self.records.append])
        self.step = 0

    def play(self, **step_records: Outputs | None) -> Batch:
        """One period in which these participants step."""
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
    *targets: str,
    state: State = State.EXPLORING,
    source: str = "r1",
) -> Outputs:
    """A step to a place, with an envelope to each of these targets."""
    outbox = tuple(
        Envelope(source, 10 * step + i, target, b"hello") for i, target in enumerate(targets)
    )
    return Outputs(step, Pose(*place), outbox=outbox, state=state)


def step_record_of(batch: Batch, name: ParticipantId) -> StepRecord:
    return next(step_record for step_record in batch.step_records if step_record.name == name)


def test_the_opening_has_all_that_the_run_starts_from() -> None:
    """Scenario, seed, points and the first look: enough to run it again."""
    scripted = ScriptedMission()
    (opening,) = scripted.records

    assert isinstance(opening, Opening)
    assert opening.scenario == scripted.simulation.scenario
    assert opening.setup.starts_m.tolist() == [list(place) for place in STARTS.values()]
    assert opening.first_look == {"r1": ((0, 3.0, 0.0),), "r2": (), "r3": ()}
    assert (opening.units.sample, opening.units.point) == (5, 2)


def test_range_is_measured_from_the_poses_before_the_moves() -> None:
    """A robot that comes into range in its step is in range of the next one."""
    scripted = ScriptedMission("radio.range_m=5")
    near = {"r1": (10.0, 0.0), "r2": (15.0, 0.0), "r3": (90.0, 0.0)}
    first, second = (
        scripted.play(**{name: outputs(step, near[name], EVERYBODY, source=name) for name in near})
        for step in (1, 2)
    )

    assert first.decisions == ()
    assert [(v.source, v.target) for v in second.decisions] == [("r1", "r2"), ("r2", "r1")]
    assert (first.out_of_range, second.out_of_range) == (6, 4)


def test_an_inbox_is_handed_out_once() -> None:
    """An envelope that a participant has received is not in its next inbox."""
    scripted = ScriptedMission()
    scripted.play(r1=outputs(1, (0.0, 0.0), "r2", "r2"))
    first = scripted.simulation.inputs("r2", 2 * PERIOD_NS)

    assert [envelope.sequence for envelope in first.inbox] == [10, 11]
    assert scripted.simulation.inputs("r2", 2 * PERIOD_NS).inbox == ()


def test_what_arrives_while_a_process_is_away_is_lost() -> None:
    """Without a fault as with one: from when it left until it is back, and nothing else."""
    scripted = ScriptedMission("radio.range_m=100")
    leave, join = (
        ProcessEvent(at_ns, "r2", kind)
        for at_ns, kind in (
            (PERIOD_NS + 1, ProcessEventKind.LEAVE),
            (2 * PERIOD_NS + 1, ProcessEventKind.JOIN),
        )
    )
    scripted.play(r1=outputs(1, (0.0, 0.0), "r2"))
    scripted.simulation.note(leave)
    scripted.play(r1=outputs(2, (0.0, 0.0), "r2", "r3"))
    scripted.simulation.note(join)
    scripted.play(r1=outputs(3, (0.0, 0.0), "r2"))
    simulation = scripted.simulation
    received = {name: simulation.inputs(name, 4 * PERIOD_NS).inbox for name in ("r2", "r3")}

    assert [envelope.sequence for envelope in received["r2"]] == [10, 30]
    assert [envelope.sequence for envelope in received["r3"]] == [21]


def test_a_step_record_has_the_inputs_of_the_step() -> None:
    """Time, observation, inbox by reference, outputs and verdict: a step can be repeated alone."""
    scripted = ScriptedMission()
    first = scripted.play(r1=outputs(1, (0.0, 0.0), EVERYBODY))
    second = scripted.play(r2=outputs(1, (20.0, 0.0), source="r2"))
    step_record = step_record_of(second, "r2")
    index = EnvelopeIndex()
    index.add(first)

    assert step_record.heard == (("r1", 10),)
    assert (step_record.now_ns, step_record.observation.pose) == (2 * PERIOD_NS, Pose(24.0, 0.0))
    assert step_record.verdict is not None
    assert step_record.verdict.pose == Pose(20.0, 0.0)
    assert index.inputs(step_record) == Inputs(
        2 * PERIOD_NS, step_record.observation, (Envelope("r1", 10, EVERYBODY, b"hello"),)
    )


def test_a_reference_to_an_envelope_that_was_never_sent_is_refused() -> None:
    """An inbox cannot be rebuilt without its envelopes."""
    scripted = ScriptedMission()
    scripted.play(r1=outputs(1, (0.0, 0.0), EVERYBODY))
    second = scripted.play(r2=outputs(1, (20.0, 0.0), source="r2"))

    with pytest.raises(KeyError):
        EnvelopeIndex().inputs(step_record_of(second, "r2"))


# Unsound outputs.

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
def test_unsound_outputs_are_treated_as_missing(name: str) -> None:
    """Bad numbers, a false sender, nothing at all: recorded as absent, without effect on others."""
    scripted = ScriptedMission()
    batch = scripted.play(r1=UNSOUND[name](), r2=outputs(1, (20.0, 0.0), "r1", source="r2"))
    absent, present = step_record_of(batch, "r1"), step_record_of(batch, "r2")

    assert batch.absent == ("r1",)
    assert (absent.outputs, absent.verdict) == (None, None)
    assert present.outputs is not None
    assert [(v.source, v.target) for v in batch.decisions] == [("r2", "r1")]
    assert scripted.simulation.inputs("r1", 2 * PERIOD_NS).observation.pose == Pose(0.0, 0.0)
    assert not scripted.simulation.acted("r1")
    assert scripted.simulation.acted("r2")


def test_a_request_is_repeated_until_it_is_answered() -> None:
    """With the same inputs, without later envelopes; the inbox is on record with the answer."""
    scripted = ScriptedMission()
    scripted.play(r2=outputs(1, (20.0, 0.0), "r1", source="r2"))
    request = scripted.simulation.request("r1", 2 * PERIOD_NS, skew_ns=7)
    scripted.simulation.settle(2 * PERIOD_NS, [request])
    silent = scripted.records[-1]
    scripted.play(r2=outputs(2, (20.0, 0.0), "r1", source="r2"))
    again = scripted.simulation.request("r1", 4 * PERIOD_NS)
    scripted.simulation.settle(4 * PERIOD_NS, [again.answered(outputs(1, (1.0, 0.0)))])
    answered = scripted.records[-1]
    assert isinstance(silent, Batch)
    assert isinstance(answered, Batch)

    assert request == again
    assert (silent.absent, answered.absent) == (("r1",), ())
    assert [step_record_of(batch, "r1").heard for batch in (silent, answered)] == [
        (),
        (("r2", 10),),
    ]
    assert (
        step_record_of(answered, "r1").now_ns
        == step_record_of(silent, "r1").now_ns
        == 2 * PERIOD_NS
    )
    assert request.inputs.now_ns == 2 * PERIOD_NS + 7
    assert scripted.simulation.unanswered("r1") is None


# The end.


def test_a_mission_is_done_when_all_robots_rest() -> None:
    """Finished and exhausted robots rest; one that explores keeps the mission going."""
    scripted = ScriptedMission()
    scripted.play(
        r1=outputs(1, (0.0, 0.0), state=State.FINISHED),
        r2=outputs(1, (24.0, 0.0), state=State.EXHAUSTED, source="r2"),
        r3=outputs(1, (90.0, 0.0), source="r3"),
    )
    before = scripted.simulation.over
    scripted.play(r3=outputs(2, (90.0, 0.0), state=State.FINISHED, source="r3"))

    assert (before, scripted.simulation.over) == (None, "done")


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
def test_robots_that_left_are_not_waited_for(
    resting: tuple[str, ...], gone: tuple[str, ...], over: str | None
) -> None:
    """Done when all remaining robots rest; deserted when none remains and one still had work."""
    scripted = ScriptedMission()
    step_records = {
        name: outputs(1, STARTS[name], state=State.FINISHED, source=name) for name in resting
    }
    if step_records:
        scripted.play(**step_records)
    scripted.simulation._gone = set(gone)

    assert scripted.simulation.over == over


def test_the_supervisor_is_not_waited_for() -> None:
    """Only the robots decide on the end: a supervisor that still sees weight does not keep it going."""
    scripted = ScriptedMission("coordination=centralized")
    for name, place in STARTS.items():
        scripted.play(**{name: outputs(1, place, state=State.FINISHED, source=name)})

    assert scripted.simulation.over == "done"


def test_a_record_ends_with_the_reason() -> None:
    """The ending has the time and the reason."""
    scripted = ScriptedMission()
    scripted.play(r1=outputs(1, (0.0, 0.0)))
    scripted.simulation.end("interrupted")

    assert scripted.records[-1] == Ending(PERIOD_NS, "interrupted")


def test_the_time_of_a_simulation_never_runs_back() -> None:
    """A step that is reported late does not set the clock of the mission back."""
    scripted = ScriptedMission()
    scripted.play(r1=outputs(1, (0.0, 0.0)))
    late = scripted.simulation.inputs("r2", PERIOD_NS // 2)
    scripted.simulation.settle(
        PERIOD_NS // 2, [Step("r2", late, outputs(1, (24.0, 0.0), source="r2"))]
    )

    assert scripted.simulation.now_ns == PERIOD_NS


# On a map.


def explored(ground: Ground, *overrides: str) -> list[Record]:
    """The record of two robots that explore a map from its lower left."""
    scenario = exploration("robots.count=2", "sensor.range_m=3", "vehicle.speed_m_s=10", *overrides)
    starts_m = np.array([[1.5, 1.5], [2.5, 1.5]])
    records: list[Record] = []
    stopped = iter(range(200))
    setup = WorldSetup(np.zeros((0, 2)), np.zeros((0, 2)), starts_m, ground)
    play(scenario, 1, setup, [records.append], stopped=lambda: next(stopped, None) is None)
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
def test_a_mission_on_a_map_is_the_same_from_its_opening(overrides: tuple[str, ...]) -> None:
    """The opening holds all that a run starts from: in a run from there, every record is the same."""
    records = explored(FLAT, *overrides)
    opening = records[0]
    assert isinstance(opening, Opening)
    ground = opening.setup.ground
    assert ground is not None
    again = explored(ground, *overrides)

    assert [encode_record(record) for record in again] == [encode_record(r) for r in records]


def test_robots_on_a_map_explore_it() -> None:
    """They sense its walls and no others, hit none, and are done."""
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
