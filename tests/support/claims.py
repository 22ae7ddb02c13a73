"""Runs that stand for one number each, for claims about them."""

from kantor_fleet.reproduce.measured_runs import MeasuredRun


def runs_of(*values: float) -> list[MeasuredRun]:
    """A run for each value."""
    return [MeasuredRun(robots_s=value) for value in values]


def number(run: MeasuredRun) -> float:
    """The value of a run."""
    return run.robots_s
