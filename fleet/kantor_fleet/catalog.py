"""The packaged scenarios, and where a scenario's name leads."""

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from kantor_protocol.scenario import Scenario, ScenarioError, load

_FOLDER = Path(str(files("kantor_fleet") / "scenarios"))
DEFAULT = "fleet"


def names() -> list[str]:
    """All packaged scenarios, the default first."""
    found = sorted(path.stem for path in _FOLDER.glob("*.toml"))
    return sorted(found, key=lambda name: name != DEFAULT)


def path_of(name: str) -> Path:
    """The file of a packaged scenario. Raises ScenarioError."""
    path = _FOLDER / f"{name}.toml"
    if name not in names():
        raise ScenarioError(f"{name}: no packaged scenario; there are {', '.join(names())}")
    return path


def find(scenario: str, overrides: Iterable[str] = ()) -> Scenario:
    """A scenario by packaged name or by file, with `key.sub=value` overrides. Raises ScenarioError."""
    if scenario.endswith(".toml") or "/" in scenario:
        return load(Path(scenario), overrides)
    return load(path_of(scenario), overrides)
