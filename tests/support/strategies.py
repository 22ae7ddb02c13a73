"""Strategies and small missions for tests: crowds of points, messages, TOML trees, teams that step by themselves."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.counter_rng import Purpose, generator
from kantor_protocol.base.machine import (
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
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import HASH_BYTES, Attestation
from kantor_protocol.wire.messages import GossipMessage
from kantor_protocol.wire.signatures import SIGNATURE_BYTES
from kantor_supervisor.density import DensitySupervisor

Points = npt.NDArray[np.float64]

SMALL = """
name = "small"
coordination = "decentralized"

[domain]
min_m = [0.0, 0.0]
max_m = [100.0, 100.0]

[robots]
count = 3

[starts]
poses_m = [[10.0, 10.0], [90.0, 20.0], [50.0, 80.0]]

[energy]
points = 30

[samples]
count = 12

[[density]]
mean_m = [50.0, 50.0]
variance_m2 = [400.0, 400.0]
"""
"""Three robots, M = 30, N = 12: L = 60, five units a sample, two a point."""

MINIMUM = ("merge=min", "claims=false")
"""Overrides that make a mission merge as the paper does."""


def examples(count: int) -> settings:
    """How many examples a property is tried on; the profile `fast` tries a tenth of them.

    Nothing is timed: the first call may compile kernels, and the machine may have other work.
    """
    share = settings().max_examples / settings.get_profile("default").max_examples
    return settings(
        max_examples=max(1, round(count * share)),
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
    )


def mission(*overrides: str) -> Scenario:
    """The small mission with `key.sub=value` overrides."""
    return parse(SMALL, "small", overrides)


def scattered(count: int, seed: int = 1, extent_m: float = 100.0) -> Points:
    """(count, 2) points, uniform in a square, the same for the same seed."""
    return generator(seed, Purpose.SAMPLES).random((count, 2)) * extent_m


# Teams: the participants of a mission with a perfect radio, and a world that accepts every move.

Transcript = list[tuple[Inputs, Outputs]]
"""The inputs and outputs of one participant, step by step."""
InRange = Callable[[ParticipantId, ParticipantId], bool]
"""Whether the second participant receives what the first sends."""

VALIDATED_ROUNDS = 5
"""Machines that a test steps round by round are validated after so many rounds."""


@contextmanager
def all_validated(*kinds: type) -> Iterator[None]:
    """Validates every machine of these kinds that is built in the context, at its end."""
    built: list[Any] = []

    def noting(kind: Any) -> Callable[..., None]:
        init = kind.__init__

        def noted(self: Any, *arguments: Any, **options: Any) -> None:
            init(self, *arguments, **options)
            built.append(self)

        return noted

    with pytest.MonkeyPatch.context() as patch:
        for kind in kinds:
            patch.setattr(kind, "__init__", noting(kind))
        yield
    for machine in built:
        machine.validate()


def build_team(
    scenario: Scenario, samples_m: Points, seed: int = 1
) -> dict[ParticipantId, StateMachine]:
    """All participants of a mission, robots first."""
    machines: dict[ParticipantId, StateMachine] = {}
    for name, start_m in zip(scenario.robot_ids, scenario.starts.poses_m, strict=True):
        machines[name] = DensityRobot(name, scenario, seed, Body(Pose(*start_m)), samples_m)
    if scenario.centralized:
        machines[SUPERVISOR] = DensitySupervisor(
            SUPERVISOR, scenario, Body(Pose(*scenario.supervisor_m)), samples_m.shape[0]
        )
    return machines


def start_poses(scenario: Scenario) -> dict[ParticipantId, Pose]:
    """The pose of every participant at time 0."""
    poses = zip(scenario.robot_ids, scenario.starts.poses_m, strict=True)
    placed = {name: Pose(*start_m) for name, start_m in poses}
    return {**placed, SUPERVISOR: Pose(*scenario.supervisor_m)}


def all_in_range(_source: ParticipantId, _receiver: ParticipantId) -> bool:
    """A radio without a limit of range."""
    return True


def in_a_row(source: ParticipantId, receiver: ParticipantId) -> bool:
    """A radio by which r1 hears r2, r2 hears r1 and r3, and so on."""
    return abs(int(source[1:]) - int(receiver[1:])) == 1


def step_rounds(
    machines: Mapping[ParticipantId, StateMachine],
    scenario: Scenario,
    rounds: int,
    in_range: InRange = all_in_range,
) -> dict[ParticipantId, Transcript]:
    """Step every machine once a period. What is sent in one round arrives before the next."""
    inboxes: dict[ParticipantId, list[Envelope]] = {name: [] for name in machines}
    places = start_poses(scenario)
    transcripts: dict[ParticipantId, Transcript] = {name: [] for name in machines}
    for step in range(1, rounds + 1):
        sent: list[Envelope] = []
        for name, machine in machines.items():
            observation = Observation(step=step - 1, pose=places[name])
            inputs = Inputs(step * scenario.period_ns, observation, tuple(inboxes[name]))
            outputs = machine.step(inputs)
            transcripts[name].append((inputs, outputs))
            places[name] = outputs.pose
            inboxes[name] = []
            sent += outputs.outbox
        for envelope in sent:
            for name in machines:
                addressed = envelope.target in ("", name) and envelope.source != name
                if addressed and in_range(envelope.source, name):
                    inboxes[name].append(envelope)
        if step % VALIDATED_ROUNDS == 0:
            validate_all(machines.values())
    return transcripts


def validate_all(machines: Iterable[StateMachine]) -> None:
    """Validate robots and supervisors."""
    for machine in machines:
        machine.validate()  # type: ignore[attr-defined]


# Numbers and places.

SEEDS = st.integers(0, 2**63 - 1)
WORDS = st.integers(0, 2**32 - 1)
COUNTS = st.integers(0, 2**63 - 1)
MOMENTS = st.integers(-(2**62), 2**62)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
UNUSABLE = st.sampled_from([math.nan, math.inf, -math.inf])
METRES = st.floats(-1e6, 1e6)
ANGLES = st.floats(-10.0, 10.0)

_LATTICE = st.integers(-3, 3).map(float)
_CROWDS_AROUND_0 = st.one_of(
    st.lists(st.tuples(METRES, METRES), min_size=1, max_size=60),
    st.lists(st.tuples(_LATTICE, _LATTICE), min_size=1, max_size=60),
    st.lists(st.tuples(METRES, st.just(2.5)), min_size=1, max_size=40),
    st.tuples(METRES, METRES).flatmap(lambda xy: st.integers(1, 30).map(lambda n: [xy] * n)),
)


@st.composite
def crowds(draw: st.DrawFn) -> Points:
    """Points scattered, on a lattice with duplicates, on a line, in one place; near 0 or far off."""
    xy_m = np.array(draw(_CROWDS_AROUND_0), dtype=np.float64)
    return xy_m + draw(st.sampled_from([0.0, 0.0, 1e3, -1e8]))


# Messages.

ATTESTATIONS = st.builds(
    Attestation,
    origin=COUNTS,
    step=COUNTS,
    length=COUNTS,
    log=st.binary(min_size=HASH_BYTES, max_size=HASH_BYTES),
    claim=st.tuples(COUNTS, COUNTS, COUNTS),
    register_stamp=COUNTS,
    register=st.sampled_from([b"", bytes(HASH_BYTES)]),
    signature=st.binary(min_size=SIGNATURE_BYTES, max_size=SIGNATURE_BYTES),
)
NEWS = st.builds(
    GossipMessage,
    version=st.just(1),
    step=COUNTS,
    x_m=FINITE,
    y_m=FINITE,
    version_vector=st.binary(max_size=40),
    logs=st.binary(max_size=40),
    claims=st.binary(max_size=40),
    registers=st.binary(max_size=40),
    incarnation=st.integers(0, 15),
    proofs=st.lists(st.binary(max_size=20), max_size=2).map(tuple),
    attestations=st.lists(ATTESTATIONS, max_size=2).map(tuple),
)
POSES = st.builds(Pose, x_m=FINITE, y_m=FINITE, heading_rad=FINITE, speed_m_s=FINITE)
ENVELOPES = st.builds(
    Envelope,
    source=st.text(max_size=8),
    sequence=COUNTS,
    target=st.text(max_size=8),
    body=st.binary(max_size=40),
)
INPUTS = st.builds(
    Inputs,
    now_ns=MOMENTS,
    observation=st.builds(
        Observation, step=COUNTS, pose=POSES, detected=st.lists(COUNTS, max_size=4).map(tuple)
    ),
    inbox=st.lists(ENVELOPES, max_size=3).map(tuple),
)
OUTPUTS = st.builds(
    Outputs,
    step=COUNTS,
    pose=POSES,
    goal=st.none() | st.tuples(FINITE, FINITE),
    spent=st.binary(max_size=20),
    lowered=st.binary(max_size=20),
    weights=st.binary(max_size=20),
    outbox=st.lists(ENVELOPES, max_size=3).map(tuple),
    energy_spent=COUNTS,
    state=st.sampled_from(State),
    refused=COUNTS,
)


# TOML trees.

_KEYS_OF_SCENARIOS = """
name summary coordination merge claims limit_s domain robots energy samples density starts
targets vehicle clock sensor radio supervisor planner publish metrics min_m max_m count
random poses_m speed_m_s period_s order spread drift_ppm jitter_s points steps mean_m
variance_m2 weight file diffusion_m range_m drop delay_s horizon modes every
"""
TOML_KEYS = st.sampled_from(_KEYS_OF_SCENARIOS.split()) | st.text(max_size=6)
_TOML_SCALARS = st.one_of(
    st.booleans(),
    st.integers(-3, 2000),
    st.integers(-(10**400), 10**400),
    st.floats(),
    st.text(max_size=12),
    st.sampled_from(["min", "ledger", "turn", "dubins", "a.csv", "b.png", "c.txt"]),
    st.dates(),
    st.datetimes(),
    st.times(),
)
TomlTree = dict[str, Any]
TOML_VALUES: st.SearchStrategy[Any] = st.recursive(
    _TOML_SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TOML_KEYS, inner, max_size=4),
    max_leaves=10,
)
TOML_TREES: st.SearchStrategy[TomlTree] = st.dictionaries(TOML_KEYS, TOML_VALUES, max_size=6)


def paths_of(tree: Any) -> list[tuple[str | int, ...]]:
    """All places in a TOML tree, each as the keys and positions that lead there."""
    inside: list[tuple[str | int, Any]] = []
    if isinstance(tree, dict):
        inside = list(tree.items())
    elif isinstance(tree, list):
        inside = list(enumerate(tree))
    return [
        way
        for key, value in inside
        for way in [(key,), *((key, *rest) for rest in paths_of(value))]
    ]


def planted(tree: Any, path: tuple[str | int, ...], value: Any) -> Any:
    """A copy of a TOML tree with the value at one place replaced."""
    if not path:
        return value
    if isinstance(tree, dict):
        return {**tree, path[0]: planted(tree.get(str(path[0])), path[1:], value)}
    copy = list(tree)
    copy[int(path[0])] = planted(copy[int(path[0])], path[1:], value)
    return copy
