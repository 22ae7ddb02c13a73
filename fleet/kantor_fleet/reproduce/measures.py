"""Measures of a run, and the CSV columns of a run on a map."""

import msgspec

from kantor_fleet.reproduce.measured_runs import MeasuredRun
from kantor_fleet.sweep.table import Row
from kantor_worldsim.observers.metrics.result import MapResult, Result


def finished(run: MeasuredRun) -> float:
    """The tick at which the team finished; the last tick of a run that was cut."""
    assert run.result is not None
    done = run.result.finished_tick
    return float(run.result.ticks if done is None else done)


def map_result_of(run: MeasuredRun) -> MapResult:
    """The result of a run on a map."""
    assert run.result is not None
    assert run.result.map is not None
    return run.result.map


def distance_m(run: MeasuredRun) -> float:
    """Distance driven by all robots together, m."""
    return map_result_of(run).distance_m


def wtv_final(run: MeasuredRun) -> float:
    """Variance of the waiting times of eight regions at the end, squared ticks."""
    return map_result_of(run).wtv_final.r8


def wtv_mean(run: MeasuredRun) -> float:
    """The same variance, averaged over the run, with the expected waits of unknown cells."""
    return map_result_of(run).wtv_mean.r8


def epv_mean(run: MeasuredRun) -> float:
    """Variance of the explored shares of eight regions, averaged over the run, squared per cent."""
    return map_result_of(run).epv_mean.r8


def map_row(result: Result) -> Row:
    """The columns of a run on a map: ticks, and all measures of the map."""
    assert result.map is not None
    measured: Row = {}
    for name, value in msgspec.to_builtins(result.map).items():
        if isinstance(value, dict):
            measured |= {f"{name}_{regions}": number for regions, number in value.items()}
        else:
            measured[name] = value
    return {"ticks": result.ticks, "finished_tick": result.finished_tick, **measured}
