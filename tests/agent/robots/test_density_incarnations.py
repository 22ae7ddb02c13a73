"""Robots and supervisors that lose their state and go on with the same body; clocks that run wrong."""

import math
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.robots.density import DensityRobot
from kantor_agent.robots.mapping import MappingRobot
from kantor_fleet.execution.in_process_team import participant, play, team
from kantor_protocol.base.machine import (
    EVERYBODY,
    SUPERVISOR,
    Body,
    Envelope,
    Inputs,
    Observation,
    Outputs,
    ParticipantId,
    Pose,
    State,
    StateMachine,
)
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.cosine_basis import rectangle_of, visit_at
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.schema import MAP_PLANNERS, Scenario
from kantor_protocol.wire.messages import GossipMessage, decode_gossip, encode_gossip
from kantor_protocol.wire.weights import Units, WeightsSubscriber
from kantor_supervisor.density import DensitySupervisor
from kantor_worldsim.record.records import Batch, Ending, Record
from kantor_worldsim.world.world import WorldSetup
from support.missions import on_map, setup_of
from support.strategies import (
    MINIMUM,
    VALIDATED_ROUNDS,
    InRange,
    all_in_range,
    build_team,
    examples,
    mission,
    scattered,
    start_poses,
    validate_all,
)

N = 12
SAMPLES_M = scattered(N)
UNITS = Units.of(30, N)
SKEWS_NS = st.integers(-3600 * 10**9, 3600 * 10**9)

MISSIONS = {
    "ledger": (),
    "min": MINIMUM,
    "centralized": ("coordination=centralized",),
    "centralized-min": ("coordination=centralized", *MINIMUM),
    "spectral": ("planner=spectral", "planner.modes=4"),
    "centralized-spectral": ("coordination=centralized", "planner=spectral", "planner.modes=4"),
    "walking": ("samples.diffusion_m=4.0",),
}
EVERY_MISSION = pytest.mark.parametrize("name", list(MISSIONS))


class Rounds:
    """All machines step once a period; what is sent in a round arrives before the next."""

    def __init__(self, scenario: Scenario, seed: int = 1) -> None:
        self.scenario, self._seed = scenario, seed
        self.machines: dict[ParticipantId, StateMachine] = build_team(scenario, SAMPLES_M, seed)
        self.bodies = {name: Body(pose) for name, pose in start_poses(scenario).items()}
        self.outputs: dict[ParticipantId, list[Outputs]] = {name: [] for name in self.machines}
        """Of all incarnations, one after the other."""
        self.beginnings: dict[ParticipantId, list[int]] = {name: [0] for name in self.machines}
        """Where in `outputs` incarnations begin."""
        self._inboxes: dict[ParticipantId, list[Envelope]] = {name: [] for name in self.machines}
        self.rounds = 0

    def begin_incarnation(self, name: ParticipantId) -> None:
        """A new incarnation takes over; what was under way to the one before is lost."""
        body = self.bodies[name]
        body = Body(body.pose, body.step, body.energy_spent, body.incarnation + 1)
        self.bodies[name], self._inboxes[name] = body, []
        self.beginnings[name].append(len(self.outputs[name]))
        if name == SUPERVISOR:
            self.machines[name] = DensitySupervisor(name, self.scenario, body, N)
        else:
            self.machines[name] = DensityRobot(name, self.scenario, self._seed, body, SAMPLES_M)

    def round(
        self,
        in_range: InRange = all_in_range,
        *,
        absent: Iterable[ParticipantId] = (),
        skew_ns: int = 0,
    ) -> None:
        """Everybody but the absent steps, r1 by a clock that is ahead; the right ones hear it."""
        self.rounds += 1
        sent: list[Envelope] = []
        for name, machine in self.machines.items():
            if name in absent:
                self._inboxes[name] = []
                continue
            body, now_ns = self.bodies[name], self.rounds * self.scenario.period_ns
            observation = Observation(body.step, body.pose)
            now_ns += skew_ns if name == "r1" else 0
            outputs = machine.step(Inputs(now_ns, observation, tuple(self._inboxes[name])))
            self.outputs[name].append(outputs)
            self._inboxes[name] = []
            self.bodies[name] = Body(
                outputs.pose, outputs.step, outputs.energy_spent, body.incarnation
            )
            sent += outputs.outbox
        for envelope in sent:
            for name in self.machines:
                wanted = envelope.target in (EVERYBODY, name) and envelope.source != name
                if wanted and name not in absent and in_range(envelope.source, name):
                    self._inboxes[name].append(envelope)
        if self.rounds % VALIDATED_ROUNDS == 0:
            validate_all(self.machines.values())

    def replica(self, name: ParticipantId) -> Replica:
        """The replica of a participant."""
        machine = self.machines[name]
        if isinstance(machine, DensityRobot):
            return machine._belief.replica
        assert isinstance(machine, DensitySupervisor)
        return machine._replica

    def consumed(self) -> Counter[int]:
        """By sample: the units that were really spent."""
        spent = Counter[int]()
        for outputs in (one for put_out in self.outputs.values() for one in put_out):
            spent.update(dict(pairs(outputs.spent)))
        return spent


def pairs(packed: bytes) -> list[tuple[int, int]]:
    """Packed pairs, read."""
    arrays = Pairs().decode(packed, N)
    assert arrays is not None
    return list(zip(arrays[0].tolist(), arrays[1].tolist(), strict=True))


@EVERY_MISSION
@examples(12)
@given(
    deaths=st.sets(st.tuples(st.integers(1, 14), st.integers(0, 3)), max_size=8),
    lost=st.sets(st.integers(0, 200), max_size=80),
)
def test_all_know_the_same_in_the_end_whatever_incarnations_begin(
    *, name: str, deaths: set[tuple[int, int]], lost: set[int]
) -> None:
    """Robots and the supervisor lose their state at any moment, messages are lost; then the radio is perfect."""
    played = Rounds(mission(*MISSIONS[name]))
    names = list(played.machines)
    copies = iter(range(10**6))
    for moment in range(15):
        for who in range(len(names)):
            if (moment, who) in deaths and played.bodies[names[who]].step > 0:
                played.begin_incarnation(names[who])
        played.round(lambda _source, _receiver: next(copies) not in lost)
    for _ in range(30):
        played.round()

    replicas = [played.replica(one) for one in names]
    weights = [held.weights.tolist() for held in replicas]
    consumed = played.consumed()
    assert weights == [weights[0]] * len(names)
    assert all(weights[0][j] >= UNITS.sample - consumed[j] for j in range(N))
    totals = [held.registers.total.tolist() for held in replicas]
    assert totals == [replicas[0].registers.values.sum(axis=0).tolist()] * len(names)
    for one in names:
        check_incarnations(played, one)


def check_incarnations(played: Rounds, name: ParticipantId) -> None:
    """Assert the rules for one participant over all its incarnations, and within each."""
    put_out, beginnings = played.outputs[name], played.beginnings[name]
    steps = list(range(1, len(put_out) + 1))
    assert [outputs.step for outputs in put_out] == steps
    assert [outputs.outbox[0].sequence for outputs in put_out] == steps
    spent = np.cumsum([bool(outputs.spent) for outputs in put_out]).tolist()
    assert [outputs.energy_spent for outputs in put_out] == spent
    assert spent[-1] <= played.scenario.steps_per_robot
    assert {outputs.refused for outputs in put_out} == {0}
    subscriber = WeightsSubscriber()
    for incarnation, (first, end) in enumerate(
        zip(beginnings, [*beginnings[1:], len(put_out)], strict=True)
    ):
        left = [UNITS.sample] * N
        for i in range(first, end):
            assert decode_gossip(put_out[i].outbox[0].body).incarnation == incarnation
            for sample, weight in pairs(put_out[i].lowered):
                assert weight < left[sample]
                left[sample] = weight
            assert (
                i > first or put_out[i].weights
            )  # a keyframe: nothing goes on from what was forgotten
            assert not put_out[i].weights or subscriber.apply(put_out[i].weights)
        assert end == first or subscriber.weights is not None


def test_sums_over_visits_count_those_of_earlier_incarnations() -> None:
    """Spectral: the visits that an incarnation has sent stay in the sums of all robots, once."""
    played = Rounds(mission(*MISSIONS["spectral"], "energy.points=60"))
    for moment in range(30):
        if moment in (6, 13):
            played.begin_incarnation("r2")
        played.round()
    scenario = played.scenario
    visits = np.zeros(16, dtype=np.int64)
    for put_out in played.outputs.values():
        for before, outputs in zip([None, *put_out], put_out, strict=False):
            start_m = scenario.starts.poses_m[scenario.robot_ids.index(outputs.outbox[0].source)]
            pose = before.pose if before else Pose(*start_m)
            if outputs.spent:
                visits += visit_at(pose.x_m, pose.y_m, rectangle_of(scenario.domain), 4)
    # All but the last word of each of the dead, which end before anybody heard it: here nobody's.
    for name in scenario.robot_ids:
        assert played.replica(name).registers.total.tolist() == visits.tolist()


def test_an_incarnation_that_takes_over_a_body_holds_for_a_step() -> None:
    """It cannot know when the body moved last; a full step could break the speed limit."""
    played = Rounds(mission(*MISSIONS["spectral"], "energy.points=300"))
    for _ in range(5):
        played.round()
    before = played.bodies["r1"].pose
    played.begin_incarnation("r1")
    played.round()
    held = played.bodies["r1"].pose
    played.round()

    assert (held.x_m, held.y_m) == (before.x_m, before.y_m)
    assert played.bodies["r1"].pose != held


# Failover.


@pytest.mark.parametrize("merge", ["centralized", "centralized-min"])
@pytest.mark.parametrize("disk", ["kept", "lost"])
def test_robots_go_on_without_a_supervisor_and_come_back(merge: str, disk: str) -> None:
    """Nine silent steps, then robots send to all in range; the first message of the supervisor ends it. Nothing is lost."""
    played = Rounds(mission(*MISSIONS[merge], "energy.points=300"))
    for _ in range(10):
        played.round()
    for _ in range(20):
        played.round(absent=[SUPERVISOR])
    if disk == "lost":
        played.begin_incarnation(SUPERVISOR)
    for _ in range(90):
        played.round()

    for name in played.scenario.robot_ids:
        alone = [outputs.outbox[0].target == EVERYBODY for outputs in played.outputs[name]]
        # It spoke last in round 10, which is heard in round 11; and first again in round 31.
        assert [i + 1 for i, one in enumerate(alone) if one] == list(range(20, 32))
        assert played.outputs[name][-1].state is not State.EXPLORING
    weights = [played.replica(name).weights.tolist() for name in played.machines]
    assert weights == [weights[0]] * 4
    if merge == "centralized":
        whole, consumed = Units.of(300, N).sample, played.consumed()
        assert weights[0] == [max(0, whole - consumed[sample]) for sample in range(N)]


def test_only_the_robot_out_of_the_supervisors_range_fails_over() -> None:
    """Failover is each robot's own: the others go on with the supervisor."""
    played = Rounds(mission("coordination=centralized", "energy.points=300"))
    for _ in range(30):
        played.round(lambda source, receiver: {source, receiver} != {SUPERVISOR, "r1"})
    targets = {
        name: played.outputs[name][-1].outbox[0].target for name in played.scenario.robot_ids
    }

    assert targets == {"r1": EVERYBODY, "r2": SUPERVISOR, "r3": SUPERVISOR}


def test_a_version_vector_beyond_the_log_is_accepted_and_changes_nothing() -> None:
    """Whoever claims to hold more of a robot's log than it has written is heard, and no more."""
    played = Rounds(mission())
    for _ in range(4):
        played.round()
    news = GossipMessage(1, 9, 0.0, 0.0, bytes([99, 0, 0, 99, 0, 0]), b"", b"")
    boast = Envelope("r2", 9, EVERYBODY, encode_gossip(news))
    machine, body = played.machines["r1"], played.bodies["r1"]
    outputs = machine.step(Inputs(10**9, Observation(body.step, body.pose), (boast,)))

    assert outputs.refused == 0
    assert pairs(outputs.lowered)


# Clocks that run wrong.


@EVERY_MISSION
@examples(15)
@given(skews=st.lists(SKEWS_NS | st.just(0), min_size=25, max_size=25))
def test_wrong_clock_breaks_no_rule(*, name: str, skews: list[int]) -> None:
    """Ahead, behind, standing or back: no step beyond a period's way, nothing refused, all agree after."""
    played = Rounds(mission(*MISSIONS[name], "vehicle.speed_m_s=20.0"))
    stride_m = 20.0 * played.scenario.clock.period_s * (1 + 1e-9)
    for skew_ns in skews:
        before = played.bodies["r1"].pose
        played.round(skew_ns=skew_ns)
        after = played.bodies["r1"].pose
        assert math.dist((before.x_m, before.y_m), (after.x_m, after.y_m)) <= stride_m
    for _ in range(20):
        played.round()

    weights = [played.replica(one).weights.tolist() for one in played.machines]
    assert weights == [weights[0]] * len(weights)
    for one in played.machines:
        check_incarnations(played, one)


def test_samples_walk_a_bounded_way_at_once_and_never_back() -> None:
    """An hour on the clock is no hour of work; whoever was away is right again soon."""
    scenario = mission("samples.diffusion_m=4.0", "energy.points=30000", "energy.steps=30000")
    robot = DensityRobot("r1", scenario, 1, Body(Pose(10.0, 10.0)), SAMPLES_M)
    walked = []
    for step, now_s in enumerate((0.1, 3600.0, 0.3, 0.4, 30.0, 30.1, 30.2, 30.3, 30.4, 30.5, 30.6)):
        robot.step(Inputs(round(now_s * 1e9), Observation(step, Pose(10.0, 10.0))))
        walked.append(robot._belief.random_walk_steps)

    assert walked == [1, 33, 33, 33, 65, 97, 129, 161, 193, 225, 257]
    late = DensityRobot("r1", scenario, 1, Body(Pose(10.0, 10.0)), SAMPLES_M)
    for step in range(12):
        late.step(Inputs(30_000_000_000 + step, Observation(step, Pose(10.0, 10.0))))
    assert late._belief.random_walk_steps == 300


# On maps, in the real world-sim.


class Faulty:
    """A participant that loses its state before some of its steps, and reads a clock that may be wrong."""

    def __init__(
        self,
        name: ParticipantId,
        scenario: Scenario,
        setup: WorldSetup,
        *,
        deaths: tuple[int, ...] = (),
        silent: tuple[int, int] = (0, 0),
        skew_s: Callable[[int], float] = lambda _step: 0.0,
    ) -> None:
        self._build = lambda body: participant(name, scenario, 1, setup, body)
        self.machine = self._build(Body(setup.poses(scenario)[name]))
        self._deaths, self._silent, self._skew_s = deaths, silent, skew_s
        self._step, self._incarnation = 0, 0

    def step(self, inputs: Inputs, /) -> Outputs:
        """The next step of the present incarnation."""
        self._step += 1
        if self._step in self._deaths:
            self._incarnation += 1
            observation = inputs.observation
            self.machine = self._build(
                Body(observation.pose, observation.step, 0, self._incarnation)
            )
        now_ns = inputs.now_ns + round(self._skew_s(self._step) * 1e9)
        outputs = self.machine.step(Inputs(now_ns, inputs.observation, inputs.inbox))
        first, last = self._silent
        return outputs if not first <= self._step < last else without_messages(outputs)


def without_messages(outputs: Outputs) -> Outputs:
    """The outputs of a participant whose radio is broken."""
    return Outputs(
        step=outputs.step,
        pose=outputs.pose,
        goal=outputs.goal,
        energy_spent=outputs.energy_spent,
        state=outputs.state,
        refused=outputs.refused,
    )


def explore(scenario: Scenario, faulty: dict[ParticipantId, Faulty]) -> list[Record]:
    """A mission with some faulty participants; no step breaks a rule of world-sim."""
    setup, records = setup_of(scenario), list[Record]()
    machines = team(scenario, 1, setup) | faulty
    play(scenario, 1, setup, [records.append], machines=machines)
    for batch in records:
        for step_record in batch.step_records if isinstance(batch, Batch) else ():
            assert step_record.verdict is not None
            assert step_record.outputs is not None
            assert step_record.verdict.violations == ()
            assert step_record.outputs.refused == 0
    return records


@pytest.mark.parametrize("planner", MAP_PLANNERS)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_map_is_explored_whatever_incarnations_begin(planner: str, coordination: str) -> None:
    """Layers of earlier incarnations count on; a robot that comes back gets targets and rests at last."""
    scenario = on_map(f"planner.name={planner}", f"coordination={coordination}", "limit_s=300")
    setup = setup_of(scenario)
    faulty = {"r2": Faulty("r2", scenario, setup, deaths=(5, 11))}
    if scenario.centralized:
        faulty[SUPERVISOR] = Faulty(SUPERVISOR, scenario, setup, deaths=(8,), silent=(8, 25))
    records = explore(scenario, faulty)
    robot = faulty["r2"].machine

    assert isinstance(records[-1], Ending)
    assert records[-1].reason == "done"
    assert isinstance(robot, MappingRobot)
    assert robot._fused_map._layers.shape[0] == 3 * len(scenario.roster)
    assert int((robot._fused_map.cells != 0).sum()) > 120


@pytest.mark.parametrize("planner", MAP_PLANNERS)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
@pytest.mark.parametrize("ahead_s", [3600.0, -3600.0])
def test_map_is_explored_by_a_clock_that_jumps_and_comes_back(
    planner: str, coordination: str, ahead_s: float
) -> None:
    """Nobody waits for an hour that was never there, neither its owner nor the others."""
    scenario = on_map(
        f"planner.name={planner}",
        f"coordination={coordination}",
        "planner.replan_gap=3",
        "limit_s=300",
    )
    setup = setup_of(scenario)

    def skew_s(step: int) -> float:
        return ahead_s if 4 <= step < 12 else 0.0

    whose = (*scenario.robot_ids[:1], *([SUPERVISOR] if scenario.centralized else []))
    for who in whose:
        records = explore(scenario, {who: Faulty(who, scenario, setup, skew_s=skew_s)})

        assert isinstance(records[-1], Ending)
        assert records[-1].reason == "done"
        resting = {
            step_record.name: step_record.outputs.state
            for batch in records
            for step_record in (batch.step_records if isinstance(batch, Batch) else ())
            if step_record.outputs
        }
        assert all(resting[name] is State.FINISHED for name in scenario.robot_ids)
