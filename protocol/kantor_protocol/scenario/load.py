"""Scenarios and schedules of faults from TOML, with overrides.

A key that does not exist, a value of the wrong type or out of bounds is refused with one line that names it.
"""

import difflib
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.faults.schedule import FAULTS_MAX, KINDS, Chaos
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.scenario.types import ScenarioTable
from kantor_protocol.scenario.validate import complaints, not_finite
from kantor_protocol.scenario.validate_faults import complaints_of_faults

Table = TypeVar("Table", bound=ScenarioTable)


def parse(text: str, origin: str, overrides: Iterable[str] = ()) -> Scenario:
    """A checked scenario from TOML text and `key.sub=value` overrides.

    `origin` names the text in messages. Raises ScenarioError.
    """
    tree = _tree_of(text, origin)
    for override in overrides:
        _override(tree, override)
    return from_tree(tree, origin)


def load(path: Path, overrides: Iterable[str] = ()) -> Scenario:
    """A checked scenario from a TOML file; relative files in it are relative to its folder.

    Raises ScenarioError.
    """
    text = _read(path, "no such scenario file; `kantor scenarios` lists the packaged ones")
    return rooted(parse(text, str(path), overrides), path.parent)


def with_chaos(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with the faults of a TOML file after its own. Raises ScenarioError."""
    tree = _tree_of(_read(path, "no such file of faults"), str(path))
    chaos = _converted(tree, Chaos, str(path))
    faults = (*scenario.faults, *chaos.faults)
    if len(faults) > FAULTS_MAX:
        raise ScenarioError(f"{path}: faults: with the scenario's own more than {FAULTS_MAX}")
    for complaint in (
        *not_finite(to_tree(chaos)),
        *complaints_of_faults(chaos.faults, scenario, scenario.faults),
    ):
        raise ScenarioError(f"{path}: {complaint}")
    return msgspec.structs.replace(scenario, faults=faults)


def rooted(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario with its relative file names turned into absolute ones below `folder`.

    A name that exists in the current folder stays relative to it, so that `--set samples.file=…` means what a
    shell user expects.
    """

    def place(name: str | None) -> str | None:
        if name is None or Path(name).is_absolute():
            return name
        try:
            Path(name).stat()  # unlike `exists`, it raises for a name that no file can have
        except (FileNotFoundError, NotADirectoryError):
            return str((folder / name).resolve())
        except (OSError, ValueError) as error:
            raise ScenarioError(f"{name}: cannot be the name of a file: {error}") from None
        return str(Path(name).resolve())

    return msgspec.structs.replace(
        scenario,
        map=scenario.map and msgspec.structs.replace(scenario.map, file=place(scenario.map.file)),
        samples=msgspec.structs.replace(scenario.samples, file=place(scenario.samples.file)),
        targets=msgspec.structs.replace(scenario.targets, file=place(scenario.targets.file)),
    )


def from_tree(tree: dict[str, Any], origin: str) -> Scenario:
    """A checked scenario from parsed TOML. Raises ScenarioError."""
    scenario = _converted(tree, Scenario, origin)
    for complaint in complaints(scenario):
        raise ScenarioError(f"{origin}: {complaint}")
    return scenario


def _read(path: Path, missing: str) -> str:
    """The text of a TOML file. missing: the message if there is no such file. Raises ScenarioError."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ScenarioError(f"{path}: {missing}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not valid TOML: {error}") from None
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from None


def _tree_of(text: str, origin: str) -> dict[str, Any]:
    """Parsed TOML. Raises ScenarioError."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{origin}: not valid TOML: {error}") from None


def _converted(tree: dict[str, Any], whole: type[Table], origin: str) -> Table:
    """Parsed TOML as a table of a kind. Raises ScenarioError."""
    try:
        return msgspec.convert(tree, whole)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{origin}: {_readable(str(error), tree, whole)}") from None
    except UnicodeEncodeError:  # a shell passes on any bytes
        raise ScenarioError(f"{origin}: a text in it is not UTF-8; write it so") from None


def _override(tree: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    path = key.strip().split(".")
    if not separator or not all(path):
        raise ScenarioError(f"--set {override}: write it as key.sub=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text.strip()
    if isinstance(value, str) and ".".join(path) in _NAMED:
        path.append("name")  # planner=spectral names the planner
    table = tree
    for i, part in enumerate(path[:-1]):
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {override}: {'.'.join(path[: i + 1])} is not a table")
    table[path[-1]] = value


_NAMED = frozenset({"planner", "vehicle"})
"""Tables for which a name alone may be given."""


def _readable(message: str, tree: Any, whole: type[ScenarioTable]) -> str:
    """Msgspec's message with the key first and, for an unknown key, the nearest known one.

    tree: the parsed TOML that msgspec could not convert to a `whole`.
    """
    problem, _, place = message.partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".")
    for kind in ("unknown", "missing required"):
        if found := re.match(rf"Object (?:contains|{kind}) (?:unknown )?field `(.+)`", problem):
            key = f"{place}.{found[1]}".lstrip(".")
            if "missing" in problem:
                known = f"; known: {', '.join(sorted(KINDS))}" if found[1] == "kind" else ""
                return f"{key}: missing; set it{known}"
            fields = _table_at(place, tree, whole).__struct_fields__
            near = difflib.get_close_matches(found[1], fields, 1)
            known = f"did you mean {near[0]}?" if near else f"known: {', '.join(fields)}"
            return f"{key}: no such key; {known}"
    if found := re.match("Invalid (?:enum )?value ('.*')$", problem, re.DOTALL):
        return f"{place}: {found[1]} is not known; known: {_choices(place, tree, whole)}"
    return f"{place}: {problem[0].lower()}{problem[1:]}" if place else problem


def _table_at(place: str, tree: Any, whole: type[ScenarioTable]) -> type[ScenarioTable]:
    """The class of the table at a place such as `radio` or `faults[2]`."""
    kind: Any = whole
    if fault := re.match(r"faults\[(\d+)\]", place):
        return KINDS[tree["faults"][int(fault[1])]["kind"]]
    for part in filter(None, re.sub(r"\[.*?\]", "", place).split(".")):
        kind = _plain(get_type_hints(kind)[part])
    table: type[ScenarioTable] = kind
    return table


def _choices(place: str, tree: Any, whole: type[ScenarioTable]) -> str:
    """The names that a key may be set to."""
    table, _, key = place.rpartition(".")
    if key == "kind":
        return ", ".join(sorted(KINDS))
    return ", ".join(get_args(_plain(get_type_hints(_table_at(table, tree, whole))[key])))


def _plain(kind: Any) -> Any:
    """A type without its optional or repeated form."""
    if get_origin(kind) in {Union, UnionType, tuple}:
        return get_args(kind)[0]
    return kind
