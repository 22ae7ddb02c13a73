"""Imports and compiled kernels that every process of a local fleet shares through the fork server.

It opens nothing: Zenoh must not be open in a process that forks.
"""

import multiprocessing
import sys
from multiprocessing.process import BaseProcess

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
from kantor_protocol.scenario.schema import MAP_PLANNERS
from kantor_protocol.wire.weights import Units
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

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


def warm_up() -> None:
    """Compile every kernel, or load it from the folder of kernels, by tiny missions.

    The first time, another process compiles those for maps meanwhile; what both need, one of them compiles.
    """
    beside = _compile_beside() if kernel_store.is_empty() else None
    for overrides in _VARIANTS:
        _play(_TINY, [*overrides, "targets.diffusion_m=1"])
    _prove()
    if beside is not None:
        beside.join()
    _play_on_maps()
    kernel_store.prune()


def _compile_beside() -> BaseProcess:
    print(
        "compiling kernels: once on this machine, for less than a minute",
        file=sys.stderr,
        flush=True,
    )
    process = multiprocessing.get_context("fork").Process(target=_be_beside, daemon=True)
    process.start()
    return process


def _be_beside() -> None:
    die_with_parent()
    _play_on_maps()


def _play_on_maps() -> None:
    for planner in sorted(MAP_PLANNERS):
        _play(_TINY_MAP, [f"planner='{planner}'"])


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


def _play(text: str, overrides: list[str]) -> None:
    scenario = parse(text, "warm-up", overrides)
    recording = Recording(scenario, 0, "in-process")
    play(scenario, 0, WorldSetup.of(scenario, 0), [recording.observe])
