"""What the README tells a newcomer to do works as it stands."""

import re
from pathlib import Path
from typing import Any

import pytest

from kantor_agent.planners.map_registry import ALLOCATORS
from kantor_agent.planners.registry import PLANNERS
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.scenarios.catalog import find, path_of
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def example(name: str) -> Any:
    """A class that the README prints."""
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    (block,) = (block for block in blocks if f"class {name}:" in block)
    names: dict[str, Any] = {}
    exec(block, names)
    return names[name]


def played(scenario: Scenario) -> Result:
    """A mission in process, with every referee."""
    recording = Recording(scenario, 0, "in-process")
    play(scenario, 0, WorldSetup.of(scenario, 0), [recording.observe])
    return recording.finish()


def test_the_planner_in_the_readme_explores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example as printed runs a mission to its end, with every rule held."""
    monkeypatch.setitem(PLANNERS, "transport", lambda _scenario: example("Nearest")())
    result = played(find("paper-decentralized", ["energy.points=400", "samples.count=200"]))

    assert (result.ended, result.complaints) == ("done", ())
    assert result.mass_left == 0.0


def test_the_planner_on_maps_in_the_readme_explores(monkeypatch: pytest.MonkeyPatch) -> None:
    """In every robot and in the supervisor, as printed."""
    monkeypatch.setitem(ALLOCATORS, "burgard", example("Polite"))
    for coordination in ("centralized", "decentralized"):
        result = played(find("office", [f"coordination={coordination}"]))

        assert (result.ended, result.complaints) == ("done", ())
        assert result.map is not None
        assert result.map.explored == 1.0


def test_the_storm_in_the_readme_is_the_packaged_one() -> None:
    """Thirty lines at most; a partition from 200 to 500 s, a robot and the supervisor killed, and it ends."""
    text = path_of("storm").read_text(encoding="utf-8")
    assert f"```toml\n{text}```" in README
    assert len(text.splitlines()) <= 30

    result = played(find("storm"))
    assert (result.ended, result.complaints, result.restarts) == ("done", (), 2)
    assert result.finished_tick is not None


def test_every_file_that_the_readme_links_exists() -> None:
    """Links and pictures inside the repository."""
    root = Path(__file__).parent.parent
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)

    assert links
    assert [link for link in links if not (root / link).exists()] == []
