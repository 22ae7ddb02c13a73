"""The table of a sweep: a row for each run, in the order of the plan.

It depends on the runs alone, not on the workers or the time: these are in a table of their own.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import msgspec

from kantor_fleet.execution.experiment import Outcome
from kantor_fleet.sweep.plan import RunKey, SweepPlan, Value, Variant, text_of
from kantor_protocol.storage.drafts import replace
from kantor_worldsim.observers.metrics.result import Result

Row = dict[str, Any]
"""A value for each column, None where there is none."""


class SweepRun(NamedTuple):
    """A finished run in its place in the plan."""

    variant: Variant
    seed: int
    outcome: Outcome


def finished(plan: SweepPlan, outcomes: Mapping[RunKey, Outcome]) -> list[SweepRun]:
    """The finished runs of a plan, in its order."""
    return [
        SweepRun(variant, seed, outcomes[plan.key(variant, seed)])
        for variant in plan.variants
        for seed in plan.seeds
        if plan.key(variant, seed) in outcomes
    ]


def _leaves(kind: type[msgspec.Struct], before: str = "") -> Iterator[tuple[str, type]]:
    """Names and types of the fields of a result; nested fields have the outer name as a prefix.

    Mappings are left out: their keys differ from variant to variant.
    """
    for name, hint in get_type_hints(kind).items():
        if get_origin(hint) is dict:
            continue
        (plain,) = set(get_args(hint) or (hint,)) - {NoneType, ...}
        if issubclass(plain, msgspec.Struct):
            yield from _leaves(plain, f"{before}{name}_")
        else:
            yield before + name, plain if plain in {bool, int, float} else str


RESULT = {name: kind for name, kind in _leaves(Result) if name not in {"seed", "wall_s"}}
"""Columns of a result and their types."""
MEASURES = tuple(name for name, kind in RESULT.items() if kind in {int, float})
"""The columns that are numbers."""
_MAP_PREFIX = "map_"


def applies(plan: SweepPlan, name: str) -> bool:
    """Whether a plan has a column of a result: those of maps need a mission on a map."""
    return not name.startswith(_MAP_PREFIX) or any(v.scenario.mapping for v in plan.variants)


def columns(plan: SweepPlan) -> dict[str, type]:
    """The columns of the table and their types. A varied key that the result has too appears once, in front."""
    axes = zip(*(variant.values for variant in plan.variants), strict=True)
    varied = {key: _kind(values) for key, values in zip(plan.keys, axes, strict=True)}
    found = {
        name: kind for name, kind in RESULT.items() if name not in varied and applies(plan, name)
    }
    return {**varied, "seed": int, **found, "failed": str}


def rows(plan: SweepPlan, runs: Iterable[SweepRun]) -> list[Row]:
    """The rows of the table."""
    blank = dict.fromkeys(columns(plan))
    return [
        blank
        | measures(run.outcome.result)
        | dict(zip(plan.keys, run.variant.values, strict=True))
        | {"seed": run.seed, "failed": run.outcome.failed}
        for run in runs
    ]


def measures(result: Result | None) -> Row:
    """A result in columns; empty without a result."""
    if result is None:
        return {}
    flat = dict(_flat(msgspec.to_builtins(result)))
    return {name: flat.get(name) for name in RESULT}


def timings(plan: SweepPlan, runs: Iterable[SweepRun]) -> list[Row]:
    """The rows of the table of times: the worker and the duration of each run."""
    return [
        dict(zip(plan.keys, run.variant.values, strict=True))
        | {"seed": run.seed, "wall_s": run.outcome.wall_s, "worker": run.outcome.worker}
        for run in runs
    ]


def write_csv(path: Path, names: Sequence[str], table: Iterable[Row]) -> None:
    """Replace a file in one step. Numbers are written so that they read back exactly."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([_cell(row[name]) for name in names] for row in table)
    replace(path, lambda draft: draft.write_text(text.getvalue(), encoding="utf-8"))


def write_parquet(path: Path, plan: SweepPlan, table: list[Row]) -> None:
    """Replace a file in one step; every column has its declared type."""
    import pyarrow as pa  # noqa: PLC0415  an extra
    from pyarrow import parquet  # noqa: PLC0415

    types = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    arrays = {
        name: pa.array(
            [None if row[name] is None else kind(row[name]) for row in table],
            types.get(kind, pa.string()),
        )
        for name, kind in columns(plan).items()
    }
    replace(path, lambda draft: parquet.write_table(pa.table(arrays), draft))


def _kind(values: Iterable[Value]) -> type:
    """The one type that holds all values of a key."""
    kinds = {type(value) for value in values}
    if kinds == {int, float}:
        return float
    return kinds.pop() if len(kinds) == 1 else str


def _flat(tree: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}_")
        else:
            yield before + name, " | ".join(value) if isinstance(value, tuple | list) else value


def _cell(value: Any) -> Any:
    """A value in CSV: empty for None, true or false, or as Python writes it."""
    if value is None:
        return ""
    return text_of(value) if isinstance(value, bool) else value
