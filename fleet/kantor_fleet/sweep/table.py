"""The table of a sweep: a row for each run, in the order of the plan.

It depends on the runs alone, not on who ran them or when: the times are in a table of their own.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import msgspec

from kantor_fleet.execution.experiment import Outcome
from kantor_fleet.sweep.plan import RunKey, SweepPlan, Value, Variant, text_of
from kantor_worldsim.observers.metrics.result import Result

Row = dict[str, Any]
"""A value for each column, None where there is none."""


class SweepRun(NamedTuple):
    """A finished run in its place in the plan."""

    variant: Variant
    seed: int
    outcome: Outcome


def finished(plan: SweepPlan, outcomes: Mapping[RunKey, Outcome]) -> list[SweepRun]:
    """What is there of a plan, in its order."""
    return [
        SweepRun(variant, seed, outcomes[plan.key(variant, seed)])
        for variant in plan.variants
        for seed in plan.seeds
        if plan.key(variant, seed) in outcomes
    ]


def _leaves(kind: type[msgspec.Struct], before: str = "") -> Iterator[tuple[str, type]]:
    """Names and types of a result, those of what is in it with its name before theirs.

    Mappings are left out: what is in them differs from variant to variant.
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
"""Columns of a result, and what is in them."""
MEASURES = tuple(name for name, kind in RESULT.items() if kind in {int, float})
"""Those that are numbers."""
_OF_MAPS = "map_"


def applies(plan: SweepPlan, name: str) -> bool:
    """Whether a column of a result says anything in a plan: those of maps need a mission with one."""
    return not name.startswith(_OF_MAPS) or any(v.scenario.mapping for v in plan.variants)


def columns(plan: SweepPlan) -> dict[str, type]:
    """The table's, and what is in them. A varied key that the result has too stands once, in front."""
    axes = zip(*(variant.values for variant in plan.variants), strict=True)
    varied = {key: _kind(values) for key, values in zip(plan.keys, axes, strict=True)}
    found = {
        name: kind for name, kind in RESULT.items() if name not in varied and applies(plan, name)
    }
    return {**varied, "seed": int, **found, "failed": str}


def rows(plan: SweepPlan, runs: Iterable[SweepRun]) -> list[Row]:
    """The table's."""
    blank = dict.fromkeys(columns(plan))
    return [
        blank
        | measures(run.outcome.result)
        | dict(zip(plan.keys, run.variant.values, strict=True))
        | {"seed": run.seed, "failed": run.outcome.failed}
        for run in runs
    ]


def measures(result: Result | None) -> Row:
    """A result in columns; nothing of what is not there."""
    if result is None:
        return {}
    flat = dict(_flat(msgspec.to_builtins(result)))
    return {name: flat.get(name) for name in RESULT}


def timings(plan: SweepPlan, runs: Iterable[SweepRun]) -> list[Row]:
    """Who ran what, and for how long."""
    return [
        dict(zip(plan.keys, run.variant.values, strict=True))
        | {"seed": run.seed, "wall_s": run.outcome.wall_s, "worker": run.outcome.worker}
        for run in runs
    ]


def write_csv(path: Path, names: Sequence[str], table: Iterable[Row]) -> None:
    """Replace a file whole. Numbers are written so that they read back as they are."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([_cell(row[name]) for name in names] for row in table)
    replace(path, lambda draft: draft.write_text(text.getvalue(), encoding="utf-8"))


def write_parquet(path: Path, plan: SweepPlan, table: list[Row]) -> None:
    """Replace a file whole; a column has one type, whatever is in it."""
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


def replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file whole or not at all."""
    draft = path.with_name(f".{path.name}.draft")
    try:
        write(draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


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
    """A value as CSV has it: nothing, true and false, or as Python writes it."""
    if value is None:
        return ""
    return text_of(value) if isinstance(value, bool) else value
