"""Missions whose processes fail: losses, recovery, and the record of both."""

import functools
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from kantor_fleet.execution.in_process_team import participant, play
from kantor_protocol.base.machine import WORLD_SIM, Body, Outputs, ParticipantId, Pose
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.scenario.faults.processes import Kill, Pause
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import decode_gossip
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import ForeignRecordError, Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    EnvelopeIndex,
    ProcessEvent,
    Record,
    StepRecord,
)
from kantor_worldsim.world.world import WorldSetup
from support.grounds import exploration
from support.missions import ROOMS
from support.records import batches, process_events
from support.strategies import SMALL, examples

MS = 1_000_000
ROOMY = ("samples.count=60", "energy.points=90", "energy.steps=60", "limit_s=12")
"""A mission of some 50 steps."""
LOSSY = ("radio.drop=0.2", "radio.duplicate=0.3", "radio.jitter_s=0.2", "radio.reorder=0.3")
PACES = {
    "concurrent": (),
    "ahead": ("radio.delay_s=0.25",),
    "turn": ("clock.order=turn",),
    "jitter": ("clock.jitter_s=0.07", "clock.drift_ppm=50000", "radio.delay_s=0.1"),
    "supervised": ("coordination=centralized", "radio.delay_s=0.1"),
}


def troubled(*faults: str, overrides: tuple[str, ...] = ()) -> Scenario:
    """A small mission with these faults, a line each."""
    tables = "".join(f"\n[[faults]]\n{fault.replace('; ', chr(10))}\n" for fault in faults)
    return parse(SMALL + tables, "troubled", (*ROOMY, *overrides))


def run(*faults: str, overrides: tuple[str, ...] = ()) -> list[Record]:
    """The record of such a mission."""
    scenario = troubled(*faults, overrides=overrides)
    records: list[Record] = []
    play(scenario, 1, WorldSetup.of(scenario, 1), [records.append])
    return records


@functools.cache
def undisturbed(overrides: tuple[str, ...]) -> list[Record]:
    """Without any fault."""
    return run(overrides=overrides)


def answered_steps(records: list[Record], name: ParticipantId) -> list[StepRecord]:
    """A participant's answered steps."""
    recorded = (step_record for batch in batches(records) for step_record in batch.step_records)
    return [
        step_record
        for step_record in recorded
        if step_record.name == name and step_record.outputs is not None
    ]


def outputs(step_record: StepRecord) -> Outputs:
    assert step_record.outputs is not None
    return step_record.outputs


def kill(who: str, from_s: float, until_s: float | None, *more: str) -> str:
    """A kill as a line."""
    end = () if until_s is None else (f"until_s = {until_s!r}",)
    return "; ".join((f'kind = "kill"; who = ["{who}"]; from_s = {from_s!r}', *end, *more))


def is_sound(records: list[Record]) -> bool:
    """Steps without a gap, no message twice, no robot beyond its energy, no rule broken."""
    answered = [
        step_record
        for batch in batches(records)
        for step_record in batch.step_records
        if step_record.outputs
    ]
    sent = Counter(
        (e.source, e.sequence) for step_record in answered for e in outputs(step_record).outbox
    )
    spent = Counter(step_record.name for step_record in answered if outputs(step_record).spent)
    steps: dict[ParticipantId, list[int]] = {}
    for step_record in answered:
        steps.setdefault(step_record.name, []).append(outputs(step_record).step)
    return (
        all(numbers == list(range(1, len(numbers) + 1)) for numbers in steps.values())
        and set(sent.values()) == {1}
        and all(count <= 60 for count in spent.values())
        and not any(
            step_record.verdict.violations for step_record in answered if step_record.verdict
        )
    )


# Killed and started again.

MOMENTS = st.integers(1, 4_500).map(lambda at_ms: at_ms / 1000 + 0.000_300_017)
"""Seconds; at these times no participant is due and no message arrives."""


@examples(25)
@given(
    pace=st.sampled_from(list(PACES)),
    who=st.sampled_from(["r1", "r3"]),
    moments_s=st.lists(MOMENTS, min_size=1, max_size=4, unique=True),
)
def test_a_restart_with_the_snapshot_changes_no_batch(
    pace: str, who: str, moments_s: list[float]
) -> None:
    """Killed and started at once at any moments, however often: every batch is the same."""
    overrides = (*LOSSY, *PACES[pace])
    kills = [kill(who, at_s, at_s + 1e-9) for at_s in sorted(moments_s)]
    records = run(*kills, overrides=overrides)
    starts = [event for event in process_events(records) if event.kind == "start"]

    assert batches(records) == batches(undisturbed(overrides))
    assert all(event.incarnation == 0 for event in starts)
    assert [(event.who, event.kind) for event in process_events(records)] == [
        (who, kind) for _ in starts for kind in ("kill", "start")
    ]


def test_a_message_that_reaches_a_dead_robot_is_lost() -> None:
    """Messages that arrive while it is dead are lost, and only they; it receives the others when it goes on."""
    records = run(kill("r2", 1.05, 2.05), overrides=("radio.delay_s=0.08",))
    heard = {
        reference
        for step_record in answered_steps(records, "r2")
        for reference in step_record.heard
    }
    arrived = {
        (decision.source, decision.sequence): decision.due_ns
        for batch in batches(records)
        for decision in batch.decisions
        if decision.target == "r2" and batch.now_ns <= 3000 * MS
    }
    missed = {reference for reference in arrived if reference not in heard}

    assert missed == {
        reference for reference, due_ns in arrived.items() if 1050 * MS <= due_ns < 2050 * MS
    }
    assert len(missed) > 10
    assert [step_record.now_ns // MS for step_record in answered_steps(records, "r2")][9:12] == [
        1000,
        2100,
        2200,
    ]
    assert is_sound(records)


@pytest.mark.parametrize("until_s", [1.35, 1.8])
@pytest.mark.parametrize("pace", list(PACES))
def test_a_step_between_its_log_entry_and_its_answer_is_neither_lost_nor_made_twice(
    pace: str, until_s: float
) -> None:
    """The robot spends once: logged before any participant receives it, reported when it is back."""
    overrides = (*LOSSY, *PACES[pace])
    records = run(kill("r2", 1.22, until_s, "mid_step = true"), overrides=overrides)
    start = next(event for event in process_events(records) if event.kind == "start")
    plain = answered_steps(undisturbed(overrides), "r2")
    silent = [batch for batch in batches(records) if batch.absent]
    answer = next(
        step_record
        for step_record in answered_steps(records, "r2")
        if outputs(step_record).step == start.step
    )
    back = next(batch for batch in batches(records) if answer in batch.step_records)

    assert [batch.absent for batch in silent] == [("r2",)]
    assert (start.incarnation, start.now_ns) == (0, round(until_s * 1e9))
    assert answer == plain[start.step - 1]
    assert (back.now_ns, back.step_records) == (start.now_ns, (answer,))
    assert answer.now_ns == silent[0].now_ns < back.now_ns
    assert is_sound(records)


def test_a_robot_without_a_step_in_the_window_dies_anyway() -> None:
    """A window between two steps; the robot goes on with its snapshot."""
    records = run(kill("r2", 1.22, 1.28, "mid_step = true"))

    assert batches(records) == batches(undisturbed(()))


@pytest.mark.parametrize("mid_step", [False, True])
@pytest.mark.parametrize("disk", ["torn", "lost"])
@pytest.mark.parametrize("pace", list(PACES))
def test_a_robot_without_its_state_comes_back_as_a_new_incarnation(
    pace: str,
    disk: str,
    mid_step: bool,  # noqa: FBT001
) -> None:
    """Its steps, messages and energy go on from the last that the world accepted, in a log of its own."""
    more = (f'disk = "{disk}"', *(("mid_step = true",) if mid_step else ()))
    kills = [kill("r1", 1.02, 1.42, *more), kill("r1", 2.02, 2.42, *more)]
    records = run(*kills, overrides=(*LOSSY, *PACES[pace]))
    starts = [event for event in process_events(records) if event.kind == "start"]
    made = answered_steps(records, "r1")
    incarnations = {
        outputs(step_record).step: decode_gossip(envelope.body).incarnation
        for step_record in made
        for envelope in outputs(step_record).outbox
    }

    assert [event.incarnation for event in starts] == [1, 2]
    assert all(incarnations[start.step] == start.incarnation - 1 for start in starts)
    assert all(incarnations[start.step + 1] == start.incarnation for start in starts)
    assert is_sound(records)
    assert outputs(made[-1]).energy_spent == sum(
        bool(outputs(step_record).spent) for step_record in made
    )


@pytest.mark.parametrize("disk", ["kept", "torn", "lost"])
def test_a_robot_that_never_stepped_keeps_its_incarnation(disk: str) -> None:
    """Killed before or in its first step, it begins as it would have begun."""
    records = run(
        kill("r1", 0.01, 0.52, f'disk = "{disk}"', "mid_step = true"),
        kill("r2", 0.01, 0.52, f'disk = "{disk}"'),
    )
    starts = {i.who: (i.incarnation, i.step) for i in process_events(records) if i.kind == "start"}

    assert starts == {"r1": (0, int(disk == "kept")), "r2": (0, 0)}
    assert is_sound(records)


# Late, paused or slow.


def test_a_late_joiner_takes_part() -> None:
    """The robot neither steps nor receives before it joins; then its first step has number 1."""
    records = run('kind = "late"; who = ["r3"]; until_s = 1.55')
    first = answered_steps(records, "r3")[0]
    sent_ns = {
        (decision.source, decision.sequence): decision.due_ns
        for batch in batches(records)
        for decision in batch.decisions
    }

    assert process_events(records) == [ProcessEvent(1550 * MS, "r3", "start", 0)]
    assert (first.now_ns, outputs(first).step) == (1600 * MS, 1)
    heard = [
        reference
        for step_record in answered_steps(records, "r3")
        for reference in step_record.heard
    ]
    assert min(sent_ns[reference] for reference in heard) >= 1550 * MS
    assert is_sound(records)


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ('kind = "pause"; who = ["r2"]; from_s = 1.0; until_s = 1.5', ("pause", "resume")),
        ('kind = "full-disk"; who = ["r2"]; from_s = 1.0; until_s = 1.5', ("fill", "free")),
    ],
)
def test_messages_to_an_idle_robot_wait(fault: str, kinds: tuple[str, str]) -> None:
    """The robot takes no step and sends nothing; then it receives all that arrived, in order of arrival."""
    records = run(fault)
    r2 = answered_steps(records, "r2")
    back = next(step_record for step_record in r2 if step_record.now_ns == 1500 * MS)
    waiting = sorted(
        (decision.due_ns, decision.source, decision.sequence)
        for batch in batches(records)
        for decision in batch.decisions
        if decision.target == "r2" and 900 * MS <= batch.now_ns < 1500 * MS
    )

    assert tuple(event.kind for event in process_events(records)) == kinds
    assert [step_record.now_ns // MS for step_record in r2][8:11] == [900, 1500, 1600]
    assert back.heard == tuple((source, sequence) for _, source, sequence in waiting)
    assert not any(batch.absent for batch in batches(records))
    assert is_sound(records)


def test_a_slow_robot_makes_some_of_its_steps() -> None:
    """One in four while it is slow, and no step number is left out."""
    records = run('kind = "slow"; who = ["r2"]; from_s = 1.0; until_s = 2.5; every = 4')
    times_ms = [step_record.now_ns // MS for step_record in answered_steps(records, "r2")]

    assert times_ms[8:15] == [900, 1200, 1600, 2000, 2400, 2500, 2600]
    assert [event.kind for event in process_events(records)] == ["slow", "quicken"]
    assert is_sound(records)


@pytest.mark.parametrize("offset_s", [-7.0, -0.25, 0.25, 7.0])
@pytest.mark.parametrize("pace", ["concurrent", "turn", "supervised"])
def test_a_wrong_clock_is_on_record_and_breaks_no_rule(pace: str, offset_s: float) -> None:
    """The robot reads the wrong time, the world uses the right one."""
    clock = f'kind = "clock"; who = ["r2"]; from_s = 1.0; until_s = 2.0; offset_s = {offset_s}'
    records = run(clock, overrides=(*LOSSY, *PACES[pace]))
    wrong = [
        step_record
        for step_record in answered_steps(records, "r2")
        if 1000 * MS <= step_record.now_ns < 2000 * MS
    ]
    step_record = next(
        step_record for step_record in answered_steps(records, "r2") if step_record.skew_ns
    )
    index = EnvelopeIndex()
    for batch in batches(records):
        index.add(batch)

    assert wrong
    assert all(
        step_record.skew_ns == max(round(offset_s * 1e9), -step_record.now_ns)
        for step_record in wrong
    )
    assert {step_record.skew_ns for step_record in answered_steps(records, "r1")} == {0}
    assert index.inputs(step_record).now_ns == step_record.now_ns + step_record.skew_ns >= 0
    assert is_sound(records)


def test_an_impostor_is_refused() -> None:
    """Another process already has that robot."""
    records = run('kind = "impostor"; who = ["r2"]; from_s = 1.0')

    assert process_events(records) == [ProcessEvent(1000 * MS, "r2", "pretend", 0)]
    assert batches(records) == batches(undisturbed(()))


# The end.


def test_a_robot_that_is_dead_for_good_is_not_waited_for() -> None:
    """The mission is done when the others rest; a robot that comes back is waited for."""
    gone = run(kill("r2", 0.52, None))
    away = run(kill("r2", 0.52, 11.0))

    assert isinstance(gone[-1], Ending)
    assert isinstance(away[-1], Ending)
    assert gone[-1].reason == away[-1].reason == "done"
    assert gone[-1].now_ns < 11_000 * MS <= away[-1].now_ns


def test_a_mission_without_a_robot_left_is_deserted() -> None:
    """The mission ends with the last death."""
    records = run(kill("r1", 0.5, None), kill("r2", 0.7, None), kill("r3", 0.7, None))

    assert records[-1] == Ending(700 * MS, "deserted")


def test_the_limit_holds_for_process_faults_too() -> None:
    """A process fault after the limit is not carried out."""
    records = run(kill("r2", 0.52, 2.5), overrides=("limit_s=2.0",))

    assert [event.kind for event in process_events(records)] == ["kill"]
    assert records[-1] == Ending(2000 * MS, "limit")


# World-sim.

LINK_FAULTS = (
    'kind = "replay"; probability = 0.3; age_s = 1.0',
    'kind = "bandwidth"; bytes_per_s = 4000',
    'kind = "duplicate"; probability = 0.3; copies = 2; delay_s = 0.3',
    'kind = "hostile"; probability = 0.2',
)


@examples(25)
@given(
    pace=st.sampled_from(list(PACES)),
    from_ms=st.integers(0, 4000),
    span_ms=st.integers(1, 1500),
    others=st.sampled_from([None, (0.35, 0.75), (-0.25, 0.1), (-0.03, 0.25)]),
)
def test_world_sim_goes_on_from_its_record(
    pace: str, from_ms: int, span_ms: int, others: tuple[float, float] | None
) -> None:
    """Killed at any moment, every batch is as after a pause, under many link faults too.

    others: a robot dies in a step, so long after the outage or before it, and comes back after it.
    """
    window = f"from_s = {from_ms / 1000!r}; until_s = {(from_ms + span_ms) / 1000!r}"
    crashes = ()
    if others is not None and from_ms / 1000 + others[0] > 0.0:
        dies_s = (from_ms + (span_ms if others[0] > 0.0 else 0)) / 1000 + others[0]
        back_s = (from_ms + span_ms) / 1000 + others[1]
        crashes = (kill("r1", dies_s, back_s, "mid_step = true", 'disk = "lost"'),)
    killed, paused = (
        run(
            f'kind = "{kind}"; who = ["worldsim"]; {window}',
            *LINK_FAULTS,
            *crashes,
            overrides=(*LOSSY, *PACES[pace], "targets.count=20"),
        )
        for kind in ("kill", "pause")
    )
    during = range(from_ms * MS, (from_ms + span_ms) * MS)

    assert [b for b in killed if not isinstance(b, ProcessEvent)][1:] == [
        b for b in paused if not isinstance(b, ProcessEvent)
    ][1:]
    assert not any(batch.now_ns in during for batch in batches(killed))
    outage = [(i.now_ns, i.kind) for i in process_events(killed) if i.who == WORLD_SIM]
    assert outage == [(during.start, "kill"), (during.stop, "start")][: len(outage)]


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_a_world_with_a_map_goes_on_from_its_record(coordination: str) -> None:
    """Scans and bumps are computed again from the recorded steps of the robots."""
    scenario = exploration(
        "robots.count=2",
        f"coordination={coordination}",
        "sensor.noise_m=0.1",
        "sensor.range_m=3",
        "radio.range_m=6",
        "vehicle.speed_m_s=10",
    )
    setup = WorldSetup(
        np.zeros((0, 2)), np.array([[9.5, 4.5]]), np.array([[1.5, 1.5], [2.5, 1.5]]), ROOMS
    )
    lost = Kill(who=("r1",), from_s=0.42, until_s=0.91, disk="lost")

    def explored(outage: Kill | Pause) -> list[Batch]:
        records: list[Record] = []
        play(replace(scenario, faults=(lost, outage)), 1, setup, [records.append])
        assert isinstance(records[-1], Ending)
        assert records[-1].reason == "done"
        assert [event.incarnation for event in process_events(records) if event.step] == [1]
        return batches(records)

    window = {"who": (WORLD_SIM,), "from_s": 1.2, "until_s": 1.5}

    assert explored(Kill(**window)) == explored(Pause(**window))  # type: ignore[arg-type]


CRASHES = (
    kill("r1", 0.72, 1.32, "mid_step = true"),
    kill("r2", 0.52, 0.92, 'disk = "lost"'),
    kill("r3", 1.22, 2.02, 'disk = "torn"', "mid_step = true"),
    'kind = "clock"; who = ["r1"]; from_s = 1.0; offset_s = -0.5',
    'kind = "pause"; who = ["r2"]; from_s = 1.3; until_s = 2.3',
    *LINK_FAULTS,
)


def killable_team(scenario: Scenario, setup: WorldSetup) -> dict[ParticipantId, KillableNode]:
    def killable_node(name: ParticipantId) -> KillableNode:
        place = Simulation(scenario, 1, setup, []).body(name).pose
        build = functools.partial(participant, name, scenario, 1, setup)
        return KillableNode(build, Body(place))

    return {name: killable_node(name) for name in scenario.roster}


@pytest.mark.parametrize("pace", ["concurrent", "ahead", "jitter", "supervised"])
def test_a_mission_goes_on_from_any_record(pace: str) -> None:
    """Stopped at any record and resumed from the records, with the robots as they are: the same record."""
    scenario = troubled(*CRASHES, overrides=(*LOSSY, *PACES[pace], "limit_s=3"))
    setup = WorldSetup.of(scenario, 1)
    whole: list[Record] = []
    play(scenario, 1, setup, [whole.append])
    for asks in range(1, 60, 2):
        exchange = InProcessExchange(killable_team(scenario, setup))
        left = iter(range(asks))
        records: list[Record] = []
        simulation = Simulation(scenario, 1, setup, [records.append])
        simulate(simulation, exchange, 1, lambda left=left: next(left, None) is None, exchange)  # type: ignore[misc]
        if records[-1] == whole[-1]:
            break
        records.pop()
        again = Simulation.resumed(scenario, 1, setup, tuple(records), [records.append])
        simulate(again, exchange, 1, lambda: False, exchange)

        assert records == whole


def test_records_that_do_not_follow_are_refused() -> None:
    """A journal of another version, or one that was changed, is refused with the number of the record."""
    scenario = troubled(overrides=LOSSY)
    setup = WorldSetup.of(scenario, 1)
    records = run(overrides=LOSSY)
    number, batch = next(
        (i, record)
        for i, record in enumerate(records)
        if isinstance(record, Batch)
        and any(step_record.heard for step_record in record.step_records)
    )
    unheard = [replace(step_record, heard=(("r1", 4711),)) for step_record in batch.step_records]
    elsewhere = [
        replace(
            step_record,
            verdict=step_record.verdict and replace(step_record.verdict, pose=Pose(1.0, 2.0)),
        )
        for step_record in batch.step_records
    ]

    for changed in (
        replace(batch, step_records=tuple(unheard)),
        replace(batch, step_records=tuple(elsewhere)),
        replace(batch, out_of_range=99),
    ):
        with pytest.raises(ForeignRecordError, match=f"^record {number}: "):
            Simulation.resumed(scenario, 1, setup, [*records[:number], changed], [])
    with pytest.raises(ForeignRecordError, match=f"^record {len(records) - 1}: "):
        Simulation.resumed(scenario, 1, setup, records, [])


def test_only_received_envelopes_are_removed_from_those_in_flight() -> None:
    """A simulation that is resumed holds exactly the envelopes that were not received yet."""
    scenario = troubled(overrides=LOSSY)
    records = run(overrides=LOSSY)[:30]
    simulation = Simulation.resumed(scenario, 1, WorldSetup.of(scenario, 1), records, [])
    in_flight = Counter(
        (v.target, v.source, v.sequence)
        for batch in batches(records)
        for v in batch.decisions
        if v.due_ns != DROPPED
    )
    for batch in batches(records):
        for step_record in batch.step_records:
            in_flight.subtract((step_record.name, *reference) for reference in step_record.heard)
    held = Counter(
        (name, envelope.source, envelope.sequence)
        for name in scenario.roster
        for envelope in simulation.channel.collect(name, 2**62)
    )

    assert held == +in_flight
    assert held.total() > 0
