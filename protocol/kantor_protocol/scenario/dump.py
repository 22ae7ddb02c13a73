"""Scenarios as plain trees and as TOML."""

from typing import Any

import msgspec

from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.scenario.types import ScenarioTable


def to_tree(scenario: ScenarioTable) -> dict[str, Any]:
    """A scenario, or another table, as plain dictionaries and lists, without keys that are None."""

    def without_none(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: without_none(v) for k, v in value.items() if v is not None}
        if isinstance(value, list | tuple):
            return [without_none(v) for v in value]
        return value

    tree: dict[str, Any] = without_none(msgspec.to_builtins(scenario))
    return tree


def to_toml(scenario: Scenario, *, brief: bool = False) -> str:
    """The scenario as TOML text that `parse` reads back as an equal one.

    brief: without keys that have their default.
    """

    def literal(value: Any) -> str:
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, str):
            return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
        if isinstance(value, list):
            return "[" + ", ".join(literal(v) for v in value) + "]"
        return repr(value)

    def body(table: dict[str, Any]) -> list[str]:
        return [f"{key} = {literal(value)}" for key, value in table.items()]

    tree = _without_defaults(scenario) if brief else to_tree(scenario)
    rows = {key: tree.pop(key, []) for key in ("density", "faults")}
    lines = body({k: v for k, v in tree.items() if not isinstance(v, dict)})
    for key, table in tree.items():
        if isinstance(table, dict) and table:
            lines += ["", f"[{key}]", *body(table)]
    for key, tables in rows.items():
        for table in tables:
            lines += ["", f"[[{key}]]", *body(table)]
    return "\n".join(lines) + "\n"


def _without_defaults(table: ScenarioTable) -> dict[str, Any]:
    """A table as plain dictionaries and lists, without keys that have their default."""

    def plain(value: Any) -> Any:
        if isinstance(value, ScenarioTable):
            return _without_defaults(value)
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    kind = table.__struct_config__
    tree = {} if kind.tag is None else {str(kind.tag_field): kind.tag}
    for field in msgspec.structs.fields(table):
        value = getattr(table, field.name)
        if value != field.default:
            tree[field.name] = plain(value)
    return tree
