"""Whole missions under link faults: they come to their end, and no rule is broken."""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.faults.links import (
    Bandwidth,
    Burst,
    Clog,
    Delay,
    Drop,
    Duplicate,
    Hostile,
    OneWay,
    Partition,
    Range,
    Reorder,
    Replay,
)
from kantor_protocol.scenario.faults.schedule import AnyFault, kind_of
from kantor_protocol.scenario.load import from_tree
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.observers.metrics.result import FaultCounts, Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import metrics_of
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.journal import Journal
from kantor_worldsim.record.records import Batch, Ending, Opening, Record
from support.faults.faulty_radio import MS
from support.faults.link_fault_strategies import SCHEDULES
from support.missions import explored
from support.strategies import SEEDS, examples, mission

Play = Callable[..., tuple[Record, ...]]

LINK_FAULTS: dict[str, AnyFault] = {
    "drop": Drop(probability=0.4),
    "burst": Burst(good_s=1.0, bad_s=0.6),
    "delay": Delay(delay_s=0.2, jitter_s=0.3),
    "duplicate": Duplicate(probability=0.5, copies=2, delay_s=0.5),
    "replay": Replay(probability=0.5, age_s=1.5),
    "reorder": Reorder(probability=0.5, hold_s=1.0),
    "one-way": OneWay(senders=("r1",), from_s=0.5, until_s=3.0),
    "halves": Partition(shape="halves", from_s=0.5, until_s=2.0),
    "isolate": Partition(shape="isolate", robots=("r1",), until_s=2.5),
    "flapping": Partition(shape="groups", groups=(("r2",),), flap_s=0.3),
    "clog": Clog(from_s=0.5, until_s=2.0),
    "bandwidth": Bandwidth(bytes_per_s=300.0),
    "bandwidth-drops": Bandwidth(bytes_per_s=300.0, queue_bytes=40),
    "range": Range(range_m=7.0, until_s=3.0),
    "hostile": Hostile(probability=0.3),
}
"""One of every kind, in every shape, such that a mission still completes."""


def under(*faults: AnyFault) -> str:
    """Faults as an override."""

    def literal(value: Any) -> str:
        if isinstance(value, dict):
            return "{" + ", ".join(f"{k} = {literal(v)}" for k, v in value.items()) + "}"
        if isinstance(value, list):
            return "[" + ", ".join(map(literal, value)) + "]"
        return repr(value)

    trees = to_tree(msgspec.structs.replace(mission(), faults=faults))["faults"]
    return f"faults={literal(trees)}"


def result_of(records: Sequence[Record]) -> Result:
    """result.json of a record."""
    first = records[0]
    assert isinstance(first, Opening)
    metrics = metrics_of(first.scenario)
    journal = Journal()
    pipeline = Pipeline(journal, metrics)
    for record in records:
        pipeline.observe(record)
    return metrics.result(
        exchange="in-process",
        digest=journal.digest.hex,
        wall_s=0.0,
        record="whole",
        complaints=tuple(check(records).violations),
    )


def completed(records: Sequence[Record], *faults: AnyFault) -> Result:
    """The result of a mission that came to its end, in which no rule was broken and every fault has had effects."""
    result = result_of(records)

    assert result.complaints == ()
    assert result.ended == "done"
    assert list(result.faults) == [f"{i} {kind_of(fault)}" for i, fault in enumerate(faults)]
    assert all(counts != FaultCounts() for counts in result.faults.values())
    return result


@pytest.mark.parametrize("name", LINK_FAULTS)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_a_mission_on_a_density_completes_under_every_fault(
    played: Play, coordination: str, name: str
) -> None:
    """Only time is lost: all mass is shipped, and no robot has shipped more than it knows of."""
    narrow = ("supervisor.range_m=60",) if coordination == "centralized" else ()
    fault = LINK_FAULTS[name]
    if isinstance(fault, Range):
        fault = msgspec.structs.replace(fault, range_m=30.0)
    overrides = (f"coordination={coordination}", *narrow, "energy.steps=90")
    result = completed(played(*overrides, under(fault)), fault)

    assert result.mass_left == 0.0
    assert result.finished_tick is not None


@pytest.mark.campaign
@pytest.mark.parametrize("name", LINK_FAULTS)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_a_mission_on_a_map_completes_under_every_fault(coordination: str, name: str) -> None:
    """The map is explored as far as it can be."""
    fault = LINK_FAULTS[name]
    place = ("supervisor.pose_m=[1.5, 1.5]",) if isinstance(fault, Range) else ()
    if isinstance(fault, Partition) and fault.shape == "halves" and coordination == "centralized":
        fault = Partition(shape="isolate", robots=("r1",), from_s=0.5, until_s=2.0)
    overrides = (f"coordination={coordination}", "radio.range_m=30", *place)
    result = completed(explored(*overrides, under(fault)), fault)

    assert result.map is not None
    assert result.map.explored == 1.0


COMBINED = (
    *(LINK_FAULTS[name] for name in ("drop", "burst", "delay", "duplicate", "replay", "reorder")),
    *(LINK_FAULTS[name] for name in ("flapping", "clog", "bandwidth", "bandwidth-drops")),
    OneWay(senders=("r1",), receivers=("r2",), until_s=1.5),
    Range(factor=0.9, until_s=3.0),
    Partition(shape="bridge", until_s=1.0),
)


def test_a_mission_completes_under_all_faults_together(played: Play) -> None:
    overrides = ("radio.range_m=95", "energy.steps=200", "energy.points=200", under(*COMBINED))
    result = completed(played(*overrides), *COMBINED)

    assert result.mass_left == 0.0


@examples(30)
@given(
    schedule=SCHEDULES,
    coordination=st.sampled_from(["decentralized", "centralized"]),
    merge=st.sampled_from([("merge=ledger",), ("merge=min", "claims=false")]),
    order=st.sampled_from(["turn", "concurrent"]),
    delay_s=st.sampled_from([0.0, 0.15]),
    seed=SEEDS,
)
def test_no_schedule_makes_a_sound_robot_break_a_rule(
    played: Play,
    schedule: tuple[AnyFault, ...],
    coordination: str,
    merge: tuple[str, ...],
    order: str,
    delay_s: float,
    seed: int,
) -> None:
    """And when the faults are over, the mission comes to its end."""
    overrides = (
        f"coordination={coordination}",
        f"clock.order={order}",
        f"radio.delay_s={delay_s}",
        "energy.steps=90",
    )
    result = result_of(played(*merge, *overrides, under(*schedule), seed=seed))

    assert result.complaints == ()
    assert result.ended == "done"


def test_the_same_seed_gives_the_same_record_under_faults() -> None:
    first, second, other = (
        result_of(explored.__wrapped__(under(*COMBINED[:8]), seed=seed)).digest
        for seed in (1, 1, 2)
    )

    assert first == second != other


def without_faults(records: Sequence[Record]) -> list[Record]:
    """The records, with no faults in the scenario of the opening."""
    first = records[0]
    assert isinstance(first, Opening)
    plain = msgspec.structs.replace(first.scenario, faults=())
    return [msgspec.structs.replace(first, scenario=plain), *records[1:]]


@pytest.mark.parametrize("name", LINK_FAULTS)
def test_a_fault_after_the_end_changes_nothing(played: Play, name: str) -> None:
    """Record by record, but for the scenario itself."""
    plain = played()
    assert isinstance(plain[-1], Ending)
    end_s = plain[-1].now_ns * 1e-9
    fault = msgspec.structs.replace(LINK_FAULTS[name], from_s=end_s + 0.01, until_s=end_s + 1.0)

    assert without_faults(played(under(fault))) == list(plain)


def test_batches_have_the_effects_of_faults(played: Play) -> None:
    """In the window, and not outside."""
    records = played(under(LINK_FAULTS["halves"]))
    times_ns = [r.now_ns for r in records if isinstance(r, Batch) and r.fault_stats]

    assert (min(times_ns), max(times_ns)) == (500 * MS, 1900 * MS)


def test_a_scenario_without_link_faults_has_no_interference() -> None:
    assert LinkFaults.of(mission(), 1) is None
    assert (
        LinkFaults.of(from_tree(to_tree(mission(under(LINK_FAULTS["drop"]))), "t"), 1) is not None
    )
