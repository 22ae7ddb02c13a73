"""The loop in virtual time: the order of events, and reproducible records."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.execution.in_process_team import play, team
from kantor_protocol.base.machine import Exchange, Inputs, Outputs, ParticipantId, Pose
from kantor_protocol.scenario.clocks import StepClock, step_clocks
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.engine.event_loop import Agenda, simulate
from kantor_worldsim.engine.simulation import Simulation, Step
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record.journal import Journal
from kantor_worldsim.record.records import Ending, Record
from kantor_worldsim.world.world import WorldSetup
from support.records import batches
from support.strategies import SEEDS, examples, mission

Play = Callable[..., tuple[Record, ...]]
MS = 1_000_000

LOSSY = (
    "radio.range_m=60",
    "radio.drop=0.3",
    "radio.duplicate=0.3",
    "radio.jitter_s=0.2",
    "radio.reorder=0.3",
)
PACES = {
    "concurrent": (),
    "turn": ("clock.order=turn",),
    "spread": ("clock.spread=0.6",),
    "jitter": ("clock.jitter_s=0.07", "clock.drift_ppm=50000"),
}


def digest(records: tuple[Record, ...]) -> str:
    journal = Journal()
    for record in records:
        journal.append(record)
    return journal.digest.hex


def run(
    scenario: Scenario,
    *,
    exchange: Callable[[Exchange], Exchange] = lambda plain: plain,
    stopped: Callable[[], bool] = lambda: False,
    prepare: Callable[[Simulation], None] = lambda simulation: None,
) -> list[Record]:
    """The records of a mission with another exchange, stop condition or simulation."""
    setup = WorldSetup.of(scenario, 1)
    records: list[Record] = []
    simulation = Simulation(scenario, 1, setup, [records.append])
    prepare(simulation)
    simulate(simulation, exchange(InProcessExchange(team(scenario, 1, setup))), 1, stopped)
    return records


# Same seed, same record.


def test_the_same_seed_gives_the_same_record() -> None:
    """Twice the same digest; another seed, another one."""
    scenario = mission("coordination=centralized", *LOSSY)
    first, second = (digest(tuple(run(scenario))) for _ in range(2))
    setup = WorldSetup.of(scenario, 2)
    others: list[Record] = []
    play(scenario, 2, setup, [others.append])

    assert first == second
    assert digest(tuple(others)) != first


DIGESTS = """
import sys
from kantor_fleet.execution.in_process_team import play, team
from kantor_protocol.scenario.load import parse
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.world.world import WorldSetup

text, *overrides = sys.argv[1:]
for coordination in ("centralized", "decentralized"):
    scenario = parse(text, "-", [f"coordination={coordination}", *overrides])
    setup = WorldSetup.of(scenario, 1)
    recording = Recording(scenario, 1, "in-process")
    play(scenario, 1, setup, [recording.observe])
    print(recording.finish().digest)
"""


@pytest.mark.processes
def test_a_record_does_not_depend_on_the_hash_seed() -> None:
    """No set or dictionary order of the interpreter reaches a record."""
    from support.strategies import SMALL

    digests = set()
    for hash_seed in ("0", "1", "4711"):
        command = [sys.executable, "-c", DIGESTS, SMALL, *LOSSY]
        environment = os.environ | {"PYTHONHASHSEED": hash_seed}
        digests.add(subprocess.check_output(command, env=environment, text=True))
    here = [
        digest(tuple(run(mission(f"coordination={coordination}", *LOSSY))))
        for coordination in ("centralized", "decentralized")
    ]

    assert digests == {"\n".join(here) + "\n"}


# The order of events.


def by_definition(scenario: Scenario, seed: int) -> list[Record]:
    """The definition of `simulate`: one moment after the other, without looking ahead."""
    setup = WorldSetup.of(scenario, seed)
    records: list[Record] = []
    simulation = Simulation(scenario, seed, setup, [records.append])
    machines = team(scenario, seed, setup)
    owned = step_clocks(scenario, seed)
    steps = dict.fromkeys(owned, 1)
    while True:
        due = {name: clock.due_ns(steps[name]) for name, clock in owned.items()}
        now_ns = min(due.values())
        if simulation.over or now_ns > scenario.limit_ns:
            simulation.end(simulation.over or "limit")
            return records
        given = {name: simulation.inputs(name, now_ns) for name in due if due[name] == now_ns}
        step_records = [
            Step(name, inputs, machines[name].step(inputs)) for name, inputs in given.items()
        ]
        simulation.settle(now_ns, step_records)
        for name in given:
            steps[name] += 1


@pytest.mark.parametrize("pace", list(PACES))
@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.1, 0.45])
def test_looking_ahead_changes_no_record(
    played: Play, pace: str, coordination: str, delay_s: float
) -> None:
    """A batch of all participants that are due within the radio's delay gives the record of the definition."""
    overrides = (
        "samples.count=60",
        "energy.points=90",
        "energy.steps=60",
        f"coordination={coordination}",
        f"radio.delay_s={delay_s}",
        *LOSSY,
        *PACES[pace],
    )

    assert list(played("targets.count=0", *overrides)) == by_definition(mission(*overrides), 1)


@examples(100)
@given(
    periods_ms=st.lists(st.integers(1, 60), min_size=1, max_size=5),
    phases_ms=st.lists(st.integers(0, 60), min_size=5, max_size=5),
    lookahead_ms=st.integers(0, 100),
    seed=SEEDS,
)
def test_the_agenda_is_in_order_and_complete(
    periods_ms: list[int], phases_ms: list[int], lookahead_ms: int, seed: int
) -> None:
    """Every step of every clock comes, once, in the order of time, none beyond the look-ahead."""
    owned = {
        f"r{i}": StepClock(period_ms * MS, phase_ms * MS, 0, 0, seed, i)
        for i, (period_ms, phase_ms) in enumerate(zip(periods_ms, phases_ms, strict=False))
    }
    agenda = Agenda(owned)
    made = []
    for _ in range(60):
        next_ns = agenda.next_ns
        batch = agenda.batch(lookahead_ms * MS)
        made.append(batch)
        assert batch[0][0] == next_ns
        assert batch[-1][0] < max(next_ns + 1, next_ns + lookahead_ms * MS)
    events = [event for batch in made for event in batch]
    last_ns = events[-1][0]
    expected = sorted(
        (clock.due_ns(step), order, name)
        for order, (name, clock) in enumerate(owned.items())
        for step in range(1, 2 + (last_ns - clock.phase_ns) // clock.period_ns)
        if clock.due_ns(step) < last_ns
    )

    assert all(len({name for _, name in batch}) == len(batch) for batch in made)
    assert [event for event in events if event[0] < last_ns] == [
        (due_ns, name) for due_ns, _, name in expected
    ]


@examples(20)
@given(
    pace=st.sampled_from(list(PACES)),
    coordination=st.sampled_from(["centralized", "decentralized"]),
    delay_ms=st.integers(0, 400),
    jitter_ms=st.integers(0, 400),
    seed=SEEDS,
)
def test_an_envelope_is_received_once_at_the_first_step_after_it_is_due(
    played: Play, pace: str, coordination: str, delay_ms: int, jitter_ms: int, seed: int
) -> None:
    """No envelope is received before it is due, and none that is due is withheld."""
    records = played(
        f"coordination={coordination}",
        *LOSSY,
        *PACES[pace],
        f"radio.delay_s={delay_ms / 1000}",
        f"radio.jitter_s={jitter_ms / 1000}",
        seed=seed,
    )
    waiting: dict[str, list[tuple[int, str, int]]] = {}
    for earlier, batch in pairwise([None, *batches(records)]):
        assert batch is not None
        for step_record in batch.step_records:
            box = waiting.setdefault(step_record.name, [])
            due = [item for item in box if item[0] <= step_record.now_ns]
            waiting[step_record.name] = [item for item in box if item[0] > step_record.now_ns]
            assert sorted(step_record.heard) == sorted(
                (source, number) for _, source, number in due
            )
        assert earlier is None or earlier.now_ns <= batch.now_ns
        for decision in batch.decisions:
            if decision.due_ns != DROPPED:
                assert decision.due_ns >= batch.now_ns + delay_ms * MS
                item = (decision.due_ns, decision.source, decision.sequence)
                waiting.setdefault(decision.target, []).append(item)


# The exchange.


def test_outputs_pass_the_codec() -> None:
    """In process too, world-sim receives a copy, of the types of the bus; inputs are frozen and passed as they are."""
    given, returned = [], []

    class Echo:
        def step(self, inputs: Inputs, /) -> Outputs:
            given.append(inputs)
            returned.append(Outputs(1, Pose(1.0, 2.0), goal=(3, 4), spent=b"abc"))
            return returned[-1]

    inputs = Inputs(
        5, Simulation(mission(), 1, WorldSetup.of(mission(), 1), []).inputs("r1", 5).observation
    )
    outputs = InProcessExchange({"r1": Echo()})({"r1": inputs})["r1"]

    assert given == [inputs]
    assert_frozen(given[0])
    assert outputs == returned[0]
    assert outputs is not returned[0]
    assert outputs.goal is not None
    assert [type(metres) for metres in outputs.goal] == [float, float]


def assert_frozen(value: object) -> None:
    """Nobody can change a value, nor anything in it."""
    if isinstance(value, msgspec.Struct):
        assert value.__struct_config__.frozen
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple):
        for each in value:
            assert_frozen(each)
    else:
        assert isinstance(value, int | float | str | bytes)


def without(name: ParticipantId, since_ns: int) -> Callable[[Exchange], Exchange]:
    """An exchange in which a participant crashes: from then on it neither steps nor answers."""

    def crashing(plain: Exchange) -> Exchange:
        def exchange(inputs: Mapping[ParticipantId, Inputs]) -> Mapping[ParticipantId, Outputs]:
            alive = {
                who: given
                for who, given in inputs.items()
                if who != name or given.now_ns < since_ns
            }
            return plain(alive)

        return exchange

    return crashing


@pytest.mark.parametrize("merge", [("merge=ledger",), ("merge=min", "claims=false")])
def test_other_robots_go_on_without_a_missing_one(merge: tuple[str, ...]) -> None:
    """A missing output is recorded as an absence; the others finish, and no rule is broken."""
    scenario = mission("energy.steps=60", *merge)
    records = run(scenario, exchange=without("r2", 350 * MS))
    step_records = [step_record for batch in batches(records) for step_record in batch.step_records]
    absences = [batch.now_ns for batch in batches(records) if batch.absent]
    there = [
        step_record.now_ns
        for step_record in step_records
        if step_record.name == "r2" and step_record.outputs is not None
    ]
    finished = {
        step_record.name
        for step_record in step_records
        if step_record.outputs is not None and step_record.outputs.state
    }

    assert there == [100 * MS, 200 * MS, 300 * MS]
    assert absences == [batch.now_ns for batch in batches(records)][3:]
    assert all(batch.absent in {(), ("r2",)} for batch in batches(records))
    assert finished == {"r1", "r3"}
    assert records[-1] == Ending(scenario.limit_ns, "limit")
    assert check(records).violations == []


def test_a_robot_that_has_left_is_not_waited_for() -> None:
    """When a robot is known to be gone, the mission ends with the others."""

    def leave(simulation: Simulation) -> None:
        simulation._gone = {"r2"}

    records = run(mission("energy.steps=60"), exchange=without("r2", 0), prepare=leave)

    assert isinstance(records[-1], Ending)
    assert records[-1].reason == "done"


def test_a_robot_that_was_late_goes_on() -> None:
    """A robot that did not answer a request answers that one first; its step numbers have no gap."""
    scenario = mission("energy.steps=60")

    def napping(plain: Exchange) -> Exchange:
        def exchange(inputs: Mapping[ParticipantId, Inputs]) -> Mapping[ParticipantId, Outputs]:
            asleep = {"r2"} if 250 * MS < inputs["r1"].now_ns < 550 * MS else set()
            return plain({who: given for who, given in inputs.items() if who not in asleep})

        return exchange

    records = run(scenario, exchange=napping)
    step_records = [
        step_record
        for batch in batches(records)
        for step_record in batch.step_records
        if step_record.name == "r2"
    ]
    steps = [
        (step_record.now_ns // (100 * MS), step_record.outputs.step)
        for step_record in step_records
        if step_record.outputs
    ]

    assert steps[:4] == [(1, 1), (2, 2), (3, 3), (7, 4)]
    assert check(records).violations == []
    assert records[-1] != Ending(scenario.limit_ns, "limit")


# The end.


def test_the_limit_ends_the_record() -> None:
    """No step is made after the limit; those that are due at it are made."""
    records = run(mission("energy.steps=60", "energy.points=3000", "limit_s=1.5"))

    assert records[-1] == Ending(1500 * MS, "limit")
    assert [batch.now_ns for batch in batches(records)] == [100 * MS * i for i in range(1, 16)]


@pytest.mark.parametrize("delay_s", [0.0, 0.45])
def test_the_limit_holds_within_a_batch(delay_s: float) -> None:
    """With any look-ahead of the loop, the record ends at the limit."""
    overrides = ("clock.order=turn", f"radio.delay_s={delay_s}", "limit_s=1.0", "energy.points=900")
    records = run(mission(*overrides))

    assert records[-1] == Ending(1000 * MS, "limit")
    assert batches(records)[-1].now_ns == 1000 * MS


def test_an_interruption_ends_the_record() -> None:
    """A mission that is stopped leaves a record that is closed, and sound up to there."""
    asked = iter(range(1000))
    records = run(mission(), stopped=lambda: next(asked) >= 4)

    assert isinstance(records[-1], Ending)
    assert records[-1].reason == "interrupted"
    assert 1 < len(records) < 7
    assert check(records).violations == []


def test_an_interruption_before_the_first_step_leaves_a_closed_record() -> None:
    """The record is an opening and an ending."""
    records = run(mission(), stopped=lambda: True)

    assert len(records) == 2
    assert records[-1] == Ending(0, "interrupted")
