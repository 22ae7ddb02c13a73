"""Imports and compiled kernels that every process of a local fleet shares through the fork server.

Missions of one kind need the kernels of that kind only: the first mission of the other kind compiles its own.

It opens nothing: Zenoh must not be open in a process that forks.
"""

import multiprocessing
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Literal

import numpy as np

import kantor_worldsim.exchange.main  # noqa: F401
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.execution.parent_death import die_with_parent
from kantor_protocol.compilation import kernel_store
from kantor_protocol.replication.parts import (
    entries_of,
    packed_claims,
    registers_in,
    speaks_of_others,
    suffixes_in,
)
from kantor_protocol.replication.registers import read_register
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import MAP_PLANNERS, Scenario
from kantor_protocol.wire.weights import Units
from kantor_worldsim.exchange.admission import Admission
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.records import Batch, Opening, Record, decode_record, encode_record
from kantor_worldsim.world.world import WorldSetup

Kind = Literal["density", "map", "faults"]
"""What missions explore, and whether anything fails in them."""
KINDS: tuple[Kind, ...] = ("density", "map", "faults")

_TINY = """
name = "warm-up"
coordination = "centralized"
domain = { min_m = [0, 0], max_m = [10, 10] }
robots = { count = 2 }
energy = { points = 8 }
samples = { count = 8 }
targets = { count = 2 }
starts = { random = true }
clock = { jitter_s = 0.01 }
radio = { drop = 0.1, duplicate = 0.1, jitter_s = 0.01, reorder = 0.1 }
density = [{ mean_m = [5, 5], variance_m2 = [4, 4] }]
"""
_TINY_MAP = """
name = "warm-up"
coordination = "centralized"
map = { layout = "blank", size_m = [16, 16] }
robots = { count = 2 }
starts = { random = true }
sensor = { range_m = 4, beams = 64, noise_m = 0.01 }
clock = { jitter_s = 0.01 }
vehicle = { speed_m_s = 20 }
radio = { drop = 0.1, duplicate = 0.1, jitter_s = 0.01, reorder = 0.1, line_of_sight = true }
"""
_VARIANTS = (
    ("merge='ledger'", "samples.diffusion_m=0"),
    ("merge='min'", "samples.diffusion_m=1"),
    ("planner='spectral'", "samples.diffusion_m=1"),
)
_FAULTS = (
    "{ kind = 'burst', good_s = 0.2, bad_s = 0.1 }, { kind = 'delay', jitter_s = 0.1 }, "
    "{ kind = 'duplicate', probability = 0.5, delay_s = 0.1 }, "
    "{ kind = 'kill', who = ['r1'], from_s = 0.15, until_s = 0.35, disk = 'lost' }"
)


def kinds_of(scenario: Scenario) -> tuple[Kind, ...]:
    """The kinds of a mission."""
    explores: Kind = "map" if scenario.mapping else "density"
    return (explores, "faults") if scenario.faults else (explores,)


def warm_up(kinds: Collection[Kind] = KINDS) -> None:
    """Compile every kernel of missions of these kinds, or load it from the folder of kernels, by tiny missions.

    The first time, another process compiles those of checkers and metrics meanwhile, by the records that come.
    """
    beside = None if all(map(kernel_store.is_complete, kinds)) else _Beside()
    missions: list[list[Record]] = []
    for text, overrides in _missions(kinds):
        records: list[Record] = []
        missions.append(records)
        _play(text, overrides, records.append if beside is None else beside.follow(records))
    if "density" in kinds:
        _prove()
    if beside is not None:
        beside.join()
    for records in missions:
        _observe(records)
    for kind in kinds:
        kernel_store.note_complete(kind)
    kernel_store.prune()


def _missions(kinds: Collection[Kind]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Texts and overrides."""
    if "density" in kinds:
        yield from ((_TINY, (*overrides, "targets.diffusion_m=1")) for overrides in _VARIANTS)
    if "faults" in kinds:
        yield _TINY, (f"faults=[{_FAULTS}]",)
    if "map" in kinds:
        yield from ((_TINY_MAP, (f"planner='{planner}'",)) for planner in sorted(MAP_PLANNERS))


def _play(text: str, overrides: Sequence[str], observe: Callable[[Record], None]) -> None:
    scenario = parse(text, "warm-up", list(overrides))
    play(scenario, 0, WorldSetup.of(scenario, 0), [observe])


def _observe(records: Iterable[Record]) -> None:
    """Have the observers of a run, and its admission, follow records, which begin with an opening."""
    follows: list[Callable[[Record], object]] = []
    for record in records:
        if isinstance(record, Opening):
            recording = Recording(record.scenario, record.seed, "in-process")
            admission = Admission(record.scenario, record.setup)
            follows = [recording.observe, admission.observe]
        elif isinstance(record, Batch):
            for step in record.step_records:
                if step.outputs is not None:
                    admission.refusal_reason(step.name, step.outputs)
        for follow in follows:
            follow(record)


class _Beside:
    """Another process, in which observers compile what they need while missions are played in this one."""

    def __init__(self) -> None:
        print(
            "compiling kernels: once on this machine, for less than a minute",
            file=sys.stderr,
            flush=True,
        )
        context = multiprocessing.get_context("fork")
        self._records = context.Queue()
        self._process = context.Process(target=self._be_beside, daemon=True)
        self._process.start()

    def follow(self, records: list[Record]) -> Callable[[Record], None]:
        """An observer that keeps records and has them observed there."""

        def observe(record: Record) -> None:
            records.append(record)
            self._records.put(encode_record(record))

        return observe

    def join(self) -> None:
        """Wait until all is observed."""
        self._records.put(None)
        self._process.join()

    def _be_beside(self) -> None:
        die_with_parent()
        _observe(map(decode_record, iter(self._records.get, None)))


def _prove() -> None:
    """What signed missions need besides: with two robots none has anything to forward."""
    replica = Replica(0, 2, 8, Units.of(8, 8), ledger=True, claims=True, proving=True)
    replica.compose()
    replica.claims_to_prove(np.zeros(2, dtype=np.int64), np.zeros((2, 2), dtype=np.int64))
    logs, claims, registers = bytes([1, 0, 1, 1, 2, 1]), packed_claims([(1, 1, 1, 0)]), b"\0\0"
    speaks_of_others(logs, claims, registers, 2, True, 0)
    for suffix in suffixes_in(logs, valued=True) or ():
        entries_of(logs, suffix, 8, 8)
    registers_in(registers, 2)
    read_register(registers, 2, 1, 0)
