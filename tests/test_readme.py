"""What the README tells a newcomer to do works as it stands."""

import re
from pathlib import Path
from typing import Any

import pytest

from kantor_agent.planners import PLANNERS
from kantor_fleet.catalog import find
from kantor_fleet.team import team
from kantor_worldsim.loop import in_process, simulate
from kantor_worldsim.recording import Recording
from kantor_worldsim.stage import Stage
from kantor_worldsim.world import Site

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_the_planner_in_the_readme_explores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example as printed runs a mission to its end, with every rule held."""
    (block,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict[str, Any] = {}
    exec(block, names)
    monkeypatch.setitem(PLANNERS, "transport", lambda _scenario: names["Nearest"]())
    scenario = find("paper-decentralized", ["energy.points=400", "samples.count=200"])
    site, recording = Site.of(scenario, 0), Recording(scenario, 0, "in-process")
    stage = Stage(scenario, 0, site, [recording.take])

    reason = simulate(stage, in_process(team(scenario, 0, site)), 0, lambda: False)

    result = recording.finish()
    assert (reason, result.complaints) == ("done", ())
    assert result.mass_left == 0.0


def test_every_file_that_the_readme_links_exists() -> None:
    """Links and pictures inside the repository."""
    root = Path(__file__).parent.parent
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)

    assert links
    assert [link for link in links if not (root / link).exists()] == []
