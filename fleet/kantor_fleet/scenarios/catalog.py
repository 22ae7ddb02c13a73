"""The packaged scenarios, found by name, and scenarios in files."""

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import load, with_chaos
from kantor_protocol.scenario.schema import Scenario

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


def find(scenario: str, overrides: Iterable[str] = (), chaos: Path | None = None) -> Scenario:
    """A scenario by packaged name or by file, with `key.sub=value` overrides. Raises ScenarioError.

    chaos: a file of faults that are added to its own.
    """
    by_file = scenario.endswith(".toml") or "/" in scenario
    found = load(_at_home(Path(scenario)) if by_file else path_of(scenario), overrides)
    return found if chaos is None else with_chaos(found, _at_home(chaos))


def _at_home(path: Path) -> Path:
    """A path in which `~` is a home; a shell leaves it in `--chaos=~/storm.toml`. Raises ScenarioError."""
    try:
        return path.expanduser()
    except RuntimeError:
        raise ScenarioError(f"{path}: no such home; write the folder out") from None
