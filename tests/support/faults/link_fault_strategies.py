"""Strategies for link faults of the small mission, and for schedules of several."""

from collections.abc import Sequence
from typing import Any

from hypothesis import strategies as st

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
from kantor_protocol.scenario.faults.schedule import AnyFault

FAULTS_WITHOUT_DRAWS: st.SearchStrategy[AnyFault] = st.sampled_from(
    [
        Drop(probability=1.0, from_s=1.0, until_s=1.5, robots=("r1",)),
        Delay(delay_s=0.2, from_s=0.5),
        Delay(delay_s=0.1, until_s=2.0, robots=("r2",)),
        OneWay(senders=("r1",), receivers=("r2",), until_s=3.0),
        Partition(shape="halves", from_s=2.0, until_s=4.0),
        Clog(from_s=3.5, until_s=5.0),
        Clog(from_s=4.0, until_s=4.5, robots=("r3",)),
        Bandwidth(bytes_per_s=150.0),
        Bandwidth(bytes_per_s=100.0, queue_bytes=30, robots=("r2",)),
        Range(range_m=40.0, from_s=0.3),
        Range(factor=0.7, robots=("r3",)),
    ]
)
NAMES = st.lists(st.sampled_from(["r1", "r2", "r3"]), unique=True, max_size=2).map(tuple)
WINDOWS = st.tuples(st.floats(0.0, 2.0), st.floats(0.001, 2.0)).map(
    lambda pair: {"from_s": pair[0], "until_s": sum(pair)}
)
SHARES = st.sampled_from([0.2, 0.5, 1.0])
SPANS = st.sampled_from([0.05, 0.3, 1.0])
FIELDS: dict[type[AnyFault], dict[str, st.SearchStrategy[Any]]] = {
    Drop: {"probability": SHARES, "robots": NAMES},
    Burst: {"good_s": SPANS, "bad_s": SPANS, "robots": NAMES},
    Delay: {"delay_s": SPANS, "jitter_s": st.sampled_from([0.0, 0.5]), "robots": NAMES},
    Duplicate: {"probability": SHARES, "copies": st.integers(1, 8), "delay_s": SPANS},
    Replay: {"probability": SHARES, "age_s": SPANS},
    Reorder: {"probability": SHARES, "hold_s": SPANS, "robots": NAMES},
    OneWay: {"senders": st.just(("r1",)), "receivers": st.just(("r2", "r3"))},
    Partition: {
        "shape": st.sampled_from(["halves", "bridge"]),
        "flap_s": st.sampled_from([None, 0.5]),
    },
    Clog: {"robots": NAMES},
    Bandwidth: {
        "bytes_per_s": st.sampled_from([50.0, 1000.0]),
        "queue_bytes": st.sampled_from([None, 0, 50]),
        "robots": NAMES,
    },
    Range: {"range_m": st.sampled_from([5.0, 40.0]), "robots": NAMES},
    Hostile: {"probability": SHARES, "robots": NAMES},
}


def faults_of(kinds: Sequence[type[AnyFault]]) -> st.SearchStrategy[AnyFault]:
    """Faults of these kinds in windows of the first seconds."""
    return st.sampled_from(kinds).flatmap(
        lambda kind: WINDOWS.flatmap(
            lambda window: st.fixed_dictionaries(FIELDS[kind]).map(
                lambda fields: kind(**window, **fields)
            )
        )
    )


FAULTS = faults_of(list(FIELDS))
FAULTS_WITHOUT_FORGERIES = faults_of([kind for kind in FIELDS if kind is not Hostile])
SCHEDULES = st.lists(FAULTS, max_size=5).map(tuple)
