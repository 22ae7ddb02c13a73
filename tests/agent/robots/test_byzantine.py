"""A robot that lies: each lie is one, within its window, the same every time; what is within stays honest."""

from collections.abc import Iterable
from functools import partial

import msgspec
import pytest

from kantor_agent.robots import decoded_parts as parts
from kantor_agent.robots.byzantine import SPELL_STEPS, ByzantineRobot, as_declared
from kantor_fleet.execution.in_process_team import lies_told, participant, team, team_identities
from kantor_protocol.base.machine import (
    EVERYBODY,
    Body,
    Inputs,
    Observation,
    Outputs,
    Pose,
    StateMachine,
)
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.replication.proofs import Chain
from kantor_protocol.scenario.faults.liars import LIES, Lie
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import attestations_in
from kantor_protocol.wire.messages import OUTBOX_MAX, GossipMessage, decode_gossip
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.record.records import Batch, Record
from kantor_worldsim.world.world import WorldSetup
from support.missions import on_map, setup_of
from support.strategies import mission

SEED = 5
FROM_S, UNTIL_S = 1.0, 4.0
BASE = ("energy.points=240", "samples.count=60", "trust=signed")


def lying(*lies: str, from_s: float = FROM_S, until_s: float = UNTIL_S) -> str:
    """The override that has r2 lie."""
    faults = (
        f'{{kind="byzantine", who=["r2"], lie="{lie}", from_s={from_s}, until_s={until_s}}}'
        for lie in lies
    )
    return f"faults=[{', '.join(faults)}]"


def played(
    scenario: Scenario, setup: WorldSetup | None = None
) -> tuple[list[Record], dict[str, StateMachine]]:
    """The records of a mission, and its team afterwards."""
    setup = setup or WorldSetup.of(scenario, SEED)
    records: list[Record] = []
    machines = team(scenario, SEED, setup)
    identities = team_identities(scenario, SEED)
    simulation = Simulation(scenario, SEED, setup, [records.append], identities)
    exchange = InProcessExchange(machines)
    simulate(simulation, exchange, SEED, lambda: False, exchange)
    return records, machines


def told_by(name: str, records: Iterable[Record]) -> list[tuple[int, Outputs]]:
    """Time and outputs of each step of a participant."""
    return [
        (step.now_ns, step.outputs)
        for record in records
        if isinstance(record, Batch)
        for step in record.step_records
        if step.name == name and step.outputs is not None
    ]


def messages(outputs: Outputs) -> list[GossipMessage]:
    """What was sent in a step."""
    return [decode_gossip(envelope.body) for envelope in outputs.outbox]


def test_the_honest_are_as_they_are() -> None:
    scenario = mission(*BASE, lying("fork"))
    setup = WorldSetup.of(scenario, SEED)
    for name, kind in (("r1", False), ("r2", True)):
        machine = participant(
            name,
            msgspec.structs.replace(scenario, trust="open"),
            SEED,
            setup,
            Body(setup.poses(scenario)[name]),
        )
        assert isinstance(machine, ByzantineRobot) == kind
    honest = mission(*BASE)
    assert as_declared("r2", honest, SEED, machine) is machine  # type: ignore[arg-type]


@pytest.mark.parametrize("lie", LIES)
def test_each_lie_is_found_out_and_is_nobody_elses(lie: Lie) -> None:
    """Named by the rules, while every rule holds for all others."""
    records, machines = played(mission(*BASE, lying(lie)))
    checker = check(records)

    assert checker.violations == []
    assert lies_told(machines["r2"]) > 0
    assert lies_told(machines["r1"]) == lies_told(machines["r3"]) == 0
    assert set(checker.lies) == {"r2"}


@pytest.mark.parametrize("lie", ["rewrite", "claim", "fork", "teleport", "silence"])
def test_each_lie_that_there_is_on_a_map_is_found_out(lie: Lie) -> None:
    scenario = on_map("trust=signed", lying(lie, from_s=0.0, until_s=60.0))
    records, machines = played(scenario, setup_of(scenario))
    checker = check(records)

    assert checker.violations == []
    assert lies_told(machines["r2"]) > 0
    assert set(checker.lies) == {"r2"}


@pytest.mark.parametrize("lie", LIES)
def test_the_same_lies_are_told_again(lie: Lie) -> None:
    scenario = mission(*BASE, lying(lie))

    assert played(scenario)[0] == played(scenario)[0]


def test_a_liar_that_is_killed_goes_on_with_the_same_lies() -> None:
    """Its write-ahead log restores it; nothing that it has said is taken back."""
    scenario = mission(*BASE, lying("overstate", "fork"))
    setup = WorldSetup.of(scenario, SEED)
    body = Body(setup.poses(scenario)["r2"])
    build = partial(
        participant, "r2", scenario, SEED, setup, identities=team_identities(scenario, SEED)
    )
    spared, killed = KillableNode(build, body), KillableNode(build, body)

    def stepped(node: KillableNode, pose: Pose, step: int) -> Outputs:
        return node.step(Inputs(step * 100_000_000, Observation(step - 1, pose)))

    pose = body.pose
    for step in range(1, 60):
        outputs = stepped(spared, pose, step)
        assert stepped(killed, pose, step) == outputs
        pose = outputs.pose
        if step in {15, 40}:
            killed.kill()
            assert killed.start(Body(pose, step), "kept") == (0, step)
    assert lies_told(killed) == lies_told(spared)


def test_outside_its_window_it_only_numbers_its_messages_otherwise() -> None:
    honest, _ = played(mission(*BASE))
    scenario = mission(*BASE, lying("claim", "rewrite", "teleport", "silence", "fork", "overstate"))
    records, _ = played(scenario)
    before = [(now_ns, out) for now_ns, out in told_by("r2", records) if now_ns < 1e9 * FROM_S]
    expected = dict(told_by("r2", honest))

    assert before
    for now_ns, outputs in before:
        (envelope,) = outputs.outbox
        assert envelope.sequence == OUTBOX_MAX * (outputs.step - 1) + 1
        (meant,) = expected[now_ns].outbox
        as_meant = msgspec.structs.replace(envelope, sequence=meant.sequence)
        assert msgspec.structs.replace(outputs, outbox=(as_meant,)) == expected[now_ns]


def test_what_is_within_stays_honest() -> None:
    """Energy, spending and steps are those that world-sim accepts; a leap is all that it refuses."""
    records, _ = played(mission(*BASE, lying(*LIES)))
    refused = [
        violation
        for record in records
        if isinstance(record, Batch)
        for step in record.step_records
        if step.verdict is not None
        for violation in step.verdict.violations
    ]
    assert set(refused) == {"speed"}


def test_an_overstated_log_ships_whole_points_and_never_more_than_there_is_energy_for() -> None:
    scenario = mission(*BASE, lying("overstate"))
    records, _ = played(scenario)
    log: dict[int, tuple[int, int]] = {}
    for _, outputs in told_by("r2", records):
        for message in messages(outputs):
            for suffix in parts.suffixes_in(message.logs, valued=True):
                if suffix.origin == 1:
                    log |= dict(enumerate(suffix.entries, suffix.start))
    spent = [units for _, units in log.values()]
    point = max(spent)

    assert sum(spent) <= scenario.steps_per_robot * point
    assert sum(units == point for units in spent) >= 10


def test_a_fork_shows_two_logs_and_attests_each() -> None:
    """To different receivers, in the same step; each is consistent with what is attested of it."""
    records, machines = played(mission(*BASE, lying("fork", until_s=7.0)))
    logs: dict[bytes, int] = {}
    two = 0
    for _, outputs in told_by("r2", records):
        shown = {message.logs for message in messages(outputs)}
        two += len(shown) > 1
        for envelope in outputs.outbox:
            for attestation in attestations_in(envelope.body):
                if attestation.origin == 1:
                    logs[attestation.log] = attestation.length
    liar = machines["r2"].machine  # type: ignore[attr-defined]
    hashes = {
        Chain(valued=True).hash(log.astype("<i4"), length)
        for log in liar._stated
        for length in set(logs.values())
    }

    assert two > 0
    assert set(logs) <= hashes
    assert len(set(logs)) > len(set(logs.values()))


def test_silence_meets_some_at_a_time_and_none_for_ever() -> None:
    records, _ = played(mission(*BASE, lying("silence", until_s=7.0)))
    targets = [
        frozenset(envelope.target for envelope in outputs.outbox)
        for now_ns, outputs in told_by("r2", records)
        if 1e9 * FROM_S <= now_ns < 7e9
    ]
    assert len(targets) > 2 * SPELL_STEPS
    assert len(set(targets)) > 1
    assert all(EVERYBODY not in each for each in targets)


def test_a_large_team_is_told_as_much_as_one_report_may_hold() -> None:
    """In turns, so that everybody hears of a forked log in time."""
    scenario = mission(
        "robots.count=14",
        "starts.poses_m=[]",
        "starts.random=true",
        "energy.points=420",
        "trust=signed",
        lying("fork"),
    )
    records, _ = played(scenario)
    within = [out for at, out in told_by("r2", records) if 1e9 * FROM_S <= at < 1e9 * UNTIL_S]

    assert {len(outputs.outbox) for outputs in within} <= {OUTBOX_MAX}
    assert len({envelope.target for outputs in within for envelope in outputs.outbox}) == 13
    assert check(records).violations == []
