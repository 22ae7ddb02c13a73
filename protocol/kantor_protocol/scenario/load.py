"""Scenarios and schedules of faults from TOML, with overrides.

A key that does not exist, a value of the wrong type or out of bounds is refused with one line that names it.
"""

import difflib
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from kantor_protocol.files.reading import NotTextError, UnreadableError, read_text
from kantor_protocol.files.toml import TomlError, parse_toml
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.faults.schedule import FAULTS_MAX, KINDS, Chaos
from kantor_protocol.scenario.file_names import rooted
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.scenario.types import ScenarioTable
from kantor_protocol.scenario.validate import complaints, unusable_numbers
from kantor_protocol.scenario.validate_faults import complaints_of_faults

Table = TypeVar("Table", bound=ScenarioTable)


def parse(text: str, origin: str, overrides: Iterable[str] = ()) -> Scenario:
    """A checked scenario from TOML text and `key.sub=value` overrides.

    `origin` names the text in messages. Raises ScenarioError.
    """
    tree = _tree_of(text, origin)
    _override(tree, [_parsed(override) for override in overrides])
    return from_tree(tree, origin)


def load(path: Path, overrides: Iterable[str] = ()) -> Scenario:
    """A checked scenario from a TOML file.

    A relative file name in it is beside it, one in an override is in the current folder. Raises ScenarioError.
    """
    text = _read(path, "no such scenario file; `kantor scenarios` lists the packaged ones")
    tree = rooted(_tree_of(text, str(path)), path.parent)
    _override(tree, [_rooted(_parsed(override), Path.cwd()) for override in overrides])
    return from_tree(tree, str(path))


def with_chaos(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with the faults of a TOML file after its own. Raises ScenarioError."""
    tree = _tree_of(_read(path, "no such file of faults"), str(path))
    chaos = _converted(tree, Chaos, str(path))
    faults = (*scenario.faults, *chaos.faults)
    if len(faults) > FAULTS_MAX:
        raise ScenarioError(f"{path}: faults: with the scenario's own more than {FAULTS_MAX}")
    for complaint in (
        *unusable_numbers(to_tree(chaos)),
        *complaints_of_faults(chaos.faults, scenario, scenario.faults),
    ):
        raise ScenarioError(f"{path}: {complaint}")
    return msgspec.structs.replace(scenario, faults=faults)


def from_tree(tree: dict[str, Any], origin: str) -> Scenario:
    """A checked scenario from parsed TOML. Raises ScenarioError."""
    scenario = _converted(tree, Scenario, origin)
    for complaint in complaints(scenario):
        raise ScenarioError(f"{origin}: {complaint}")
    return scenario


def _read(path: Path, missing: str) -> str:
    """The text of a TOML file. missing: the message if there is no such file. Raises ScenarioError."""
    try:
        return read_text(path)
    except NotTextError as error:
        raise ScenarioError(f"{path}: not valid TOML: {error.problem}") from None
    except UnreadableError as error:
        problem = missing if error.missing else f"cannot be read: {error.problem}"
        raise ScenarioError(f"{path}: {problem}") from None


def _tree_of(text: str, origin: str) -> dict[str, Any]:
    """Parsed TOML. Raises ScenarioError."""
    try:
        return parse_toml(text)
    except TomlError as error:
        raise ScenarioError(f"{origin}: not valid TOML: {error}") from None


def _converted(tree: dict[str, Any], whole: type[Table], origin: str) -> Table:
    """Parsed TOML as a table of a kind. Raises ScenarioError."""
    try:
        return msgspec.convert(tree, whole)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{origin}: {_readable(str(error), tree, whole)}") from None
    except UnicodeEncodeError:  # a shell passes on any bytes
        raise ScenarioError(f"{origin}: a text in it is not UTF-8; write it so") from None


class _Override(NamedTuple):
    """A value for a key of a scenario."""

    text: str
    """As it was given."""
    path: tuple[str, ...]
    value: Any

    @property
    def key(self) -> str:
        return ".".join(self.path)


def _parsed(text: str) -> _Override:
    """An override from `key.sub=value`. Raises ScenarioError."""
    key, separator, written = text.partition("=")
    path = key.strip().split(".")
    if not separator or not all(path):
        raise ScenarioError(f"--set {text}: write it as key.sub=value")
    if len(path) > _PARTS_MAX:
        raise ScenarioError(f"--set {text[:80]}: no key has so many parts")
    value = value_of(written)
    if isinstance(value, str) and ".".join(path) in _NAMED:
        path.append("name")  # planner=spectral names the planner
    return _Override(text, tuple(path), value)


def value_of(text: str) -> Any:
    """A value as it is typed: TOML, or plain text without its quotes."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except TomlError:
        return text.strip()


def _rooted(override: _Override, folder: Path) -> _Override:
    return override._replace(value=rooted(override.value, folder, override.key))


def _override(tree: dict[str, Any], overrides: Sequence[_Override]) -> None:
    """Set the keys of a tree, in order. Raises ScenarioError."""
    _give_way(tree, {override.key for override in overrides})
    for override in overrides:
        table = tree
        for i, part in enumerate(override.path[:-1]):
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                above = ".".join(override.path[: i + 1])
                raise ScenarioError(f"--set {override.text}: {above} is not a table")
        table[override.path[-1]] = override.value


def _give_way(tree: dict[str, Any], keys: Collection[str]) -> None:
    """Leave out what describes the map that an override replaces: a layout for a file, or a file for a layout."""
    options = tree.get("map")
    if isinstance(options, dict) and ("map.file" in keys) != ("map.layout" in keys):
        replaced = _OF_LAYOUT if "map.file" in keys else _OF_FILE
        for key in replaced:
            options.pop(key, None)


_OF_LAYOUT = ("layout", "size_m", "resolution_m", "seed")
_OF_FILE = ("file", "resolution_m")
_PARTS_MAX = 8


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
