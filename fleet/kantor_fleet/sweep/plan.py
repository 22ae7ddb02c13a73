"""The plan of a sweep: variants of a scenario, each with the same seeds."""

import contextlib
import functools
import hashlib
import itertools
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from kantor_fleet.execution.experiment import Case, code
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.files.reading import UnreadableError, check, digest_of
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import value_of
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.inputs import Digest, InputFile, inputs_of
from kantor_worldsim.world.world import doubts_about

Value = bool | int | float | str

_SEEDS_MAX = 1_000_000


class SweepError(ScenarioError):
    """A sweep that cannot be run; the message is one line with the place and the remedy."""


class RunKey(NamedTuple):
    """The identity of a run, the same in every sweep."""

    scenario: str
    """Digest of the resolved scenario and of the files that it names."""
    code: str
    """Digest of the sources: after a change of a planner, its runs are other runs."""
    seed: int
    exact: bool


class Variant(NamedTuple):
    """One of the scenarios of a sweep."""

    values: tuple[Value, ...]
    """A value for each varied key."""
    scenario: Scenario
    digest: str
    inputs: tuple[InputFile, ...] = ()
    """The files that it is read from, as they were when the sweep was planned."""

    def settings(self, keys: Iterable[str]) -> dict[str, str]:
        """Its values by key, as a user writes them."""
        return dict(zip(keys, map(text_of, self.values), strict=True))


class SweepPlan(NamedTuple):
    """A sweep before it runs."""

    keys: tuple[str, ...]
    """The varied keys."""
    variants: tuple[Variant, ...]
    """The product of all values, the last key fastest."""
    seeds: tuple[int, ...]
    """The same for every variant, so that runs can be compared in pairs."""
    exact: bool = False

    @property
    def name(self) -> str:
        """The name of the scenario."""
        return self.variants[0].scenario.name

    def key(self, variant: Variant, seed: int) -> RunKey:
        """The key of a run in the journal."""
        return RunKey(variant.digest, code(), seed, self.exact)

    def cases(self) -> Iterator[tuple[RunKey, Case]]:
        """All runs, seed by seed: a sweep that is cut short has every variant with the same seeds."""
        for seed in self.seeds:
            for variant in self.variants:
                case = Case(variant.scenario, seed, self.exact, variant.inputs)
                yield self.key(variant, seed), case

    def doubts(self) -> list[str]:
        """Warnings about the files of its scenarios, each once; a file that cannot be read fails its runs."""
        by_source = {
            (scenario.map, scenario.samples.file, scenario.targets.file): scenario
            for scenario in (variant.scenario for variant in self.variants if variant.inputs)
        }
        found: dict[str, None] = {}
        for scenario in by_source.values():
            with contextlib.suppress(ScenarioError):
                found |= dict.fromkeys(doubts_about(scenario))
        return list(found)


def plan(
    scenario: str,
    vary: Sequence[str],
    seeds: str,
    overrides: Sequence[str] = (),
    chaos: Path | None = None,
    *,
    exact: bool = False,
) -> SweepPlan:
    """The plan of a sweep; every variant has been checked.

    scenario: as `catalog.find` takes it. vary: each `key.sub=value,value`. seeds: see `parse_seeds`.
    overrides: for all variants alike. chaos: a file of faults, for all alike. Raises ScenarioError.
    """
    varied = dict(_axis(text) for text in vary)
    keys = [text.partition("=")[0].strip() for text in vary]
    for key, times in Counter(keys).items():
        if times > 1:
            raise SweepError(f"--vary {key}: given {times} times; put all its values into one")
    for override in overrides:
        if override.partition("=")[0].strip() in varied:
            raise SweepError(f"--set {override}: it is varied as well; drop one of the two")
    digest = functools.cache(digest_of)  # variants share most of their files
    variants = [
        _variant(scenario, overrides, chaos, dict(zip(varied, texts, strict=True)), digest)
        for texts in itertools.product(*varied.values())
    ]
    _refuse_twins(variants, tuple(varied))
    return SweepPlan(tuple(varied), tuple(variants), parse_seeds(seeds), exact)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from `0:50` (half-open), `7`, `1,4,9`, or several of these. Raises SweepError."""
    seeds: list[int] = []
    for part in text.split(","):
        first, colon, end = part.partition(":")
        try:
            span = range(int(first), int(end)) if colon else range(int(first), int(first) + 1)
        except ValueError:
            raise SweepError(f"--seeds {text}: write 0:50, 7, or 1,4,9") from None
        if not span:
            raise SweepError(f"--seeds {text}: no seeds; the end is not one of them")
        if span[0] < 0 or span[-1] >= 2**63:
            raise SweepError(f"--seeds {text}: give whole numbers from 0 to 2^63 - 1")
        if len(span) + len(seeds) > _SEEDS_MAX:
            raise SweepError(f"--seeds {text}: at most {_SEEDS_MAX} seeds")
        seeds += span
    if len(set(seeds)) < len(seeds):
        raise SweepError(f"--seeds {text}: a seed is given twice")
    return tuple(seeds)


def text_of(value: Value) -> str:
    """A value as a user writes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _axis(text: str) -> tuple[str, list[str]]:
    """A varied key and its values as texts."""
    key, separator, values = text.partition("=")
    key = key.strip()
    if not separator or not key:
        raise SweepError(f"--vary {text}: write it as key.sub=value,value")
    texts = _split(values)
    if texts is None:
        raise SweepError(f"--vary {text}: a quote without its end; close it")
    if not all(texts):
        raise SweepError(f"--vary {text}: a value is missing; write {key}=value,value")
    return key, texts


def _split(values: str) -> list[str] | None:
    """Parts between the commas that stand in no bracket and no quotes; None if a quote has no end.

    As in TOML, a quote stands at the beginning of a value, or in brackets; elsewhere it is a letter.
    """
    parts, depth, quote, escaped = [""], 0, "", False
    for letter in values:
        if quote:
            ends = letter == quote and not escaped
            escaped = letter == "\\" and quote == '"' and not escaped
            quote = "" if ends else quote
        elif letter in "\"'" and (depth > 0 or not parts[-1].strip(_BEFORE_QUOTE)):
            quote = letter
        else:
            depth += (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return None if quote else [part.strip() for part in parts]


_BEFORE_QUOTE = " \t\"'"
"""Three quotes begin a text as one does."""


def _variant(
    scenario: str,
    overrides: Sequence[str],
    chaos: Path | None,
    texts: dict[str, str],
    digest: Digest,
) -> Variant:
    settings = [f"{key}={text}" for key, text in texts.items()]
    try:
        resolved = find(scenario, [*overrides, *settings], chaos)
        inputs = inputs_of(resolved, digest)
        _check_inputs(inputs)
    except ScenarioError as error:
        place = f"{' '.join(settings)}: " if settings else ""
        raise SweepError(f"{place}{error}") from None
    values = tuple(map(_value, texts.values()))
    return Variant(values, resolved, _digest(resolved, inputs), inputs)


def _value(text: str) -> Value:
    """The value of a text in a table: a plain TOML value, or else the text itself."""
    value = value_of(text)
    return value if isinstance(value, bool | int | float | str) else text


def _digest(scenario: Scenario, inputs: Sequence[InputFile]) -> str:
    """Digest of a scenario and of the contents of its files, wherever these are."""
    tree = to_tree(scenario)
    for file in inputs:
        table, _, key = file.key.partition(".")
        tree[table][key] = f"{file.path.suffix}{file.blake2b}"
    return hashlib.blake2b(msgspec.json.encode(tree), digest_size=16).hexdigest()


def _check_inputs(inputs: Iterable[InputFile]) -> None:
    """Refuse files that cannot be read. Raises SweepError."""
    for file in inputs:
        if file.blake2b is None:
            try:
                check(file.path, sys.maxsize)
            except UnreadableError as error:
                raise SweepError(f"{file.key}: {error}") from None
            raise SweepError(f"{file.key}: {file.path}: cannot be read; check who may")


def _refuse_twins(variants: Sequence[Variant], keys: Sequence[str]) -> None:
    """Refuse variants that are the same scenario. Raises SweepError."""
    first: dict[str, Variant] = {}
    for variant in variants:
        twin = first.setdefault(variant.digest, variant)
        if twin is not variant:
            one, other = (
                " ".join(f"{key}={text}" for key, text in each.settings(keys).items())
                for each in (twin, variant)
            )
            raise SweepError(f"--vary: {one} and {other} are the same scenario; drop one")
