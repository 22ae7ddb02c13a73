"""What is read off a run, and what the CSV says of one that explored a map."""

import msgspec

from kantor_fleet.reproduce.measured_runs import MeasuredRun
from kantor_fleet.sweep.table import Row
from kantor_worldsim.observers.metrics.result import MapResult, Result


def finished(run: MeasuredRun) -> float:
    """The tick at which the team finished; the last one for a run that was cut."""
    assert run.result is not None
    done = run.result.finished_tick
    return float(run.result.ticks if done is None else done)


def map_result_of(run: MeasuredRun) -> MapResult:
    """What a run over a map came to."""
    assert run.result is not None
    assert run.result.map is not None
    return run.result.map


def distance_m(run: MeasuredRun) -> float:
    """Driven by all robots together."""
    return map_result_of(run).distance_m


def wtv_final(run: MeasuredRun) -> float:
    """Variance of the waiting times of eight regions at the end, squared ticks."""
    return map_result_of(run).wtv_final.r8


def wtv_mean(run: MeasuredRun) -> float:
    """The same over the run, with the waits that are expected of unknown cells."""
    return map_result_of(run).wtv_mean.r8


def epv_mean(run: MeasuredRun) -> float:
    """Variance of the explored share of eight regions over the run, squared per cent."""
    return map_result_of(run).epv_mean.r8


def map_row(result: Result) -> Row:
    """A run over a map: ticks, and all that was measured of the map."""
    assert result.map is not None
    measured: Row = {}
    for name, value in msgspec.to_builtins(result.map).items():
        if isinstance(value, dict):
            measured |= {f"{name}_{regions}": number for regions, number in value.items()}
        else:
            measured[name] = value
    return {"ticks": result.ticks, "finished_tick": result.finished_tick, **measured}
