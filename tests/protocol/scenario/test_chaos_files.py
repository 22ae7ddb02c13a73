"""Files of faults (`--chaos`): added to those of a scenario, and refused by name."""

from pathlib import Path

import pytest

from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import parse, with_chaos
from kantor_protocol.scenario.schema import Scenario
from support.faults.fault_tables import EVERY_KIND, fault
from support.strategies import SMALL, mission


def with_chaos_file(folder: Path, text: str, scenario: Scenario | None = None) -> Scenario:
    path = folder / "chaos.toml"
    path.write_text(text)
    return with_chaos(scenario or mission(), path)


def test_a_file_adds_its_faults_behind(tmp_path: Path) -> None:
    own = mission(fault(kind="drop", probability=0.5))
    extended = with_chaos_file(tmp_path, EVERY_KIND, own)

    assert extended.faults == (*own.faults, *parse(SMALL + EVERY_KIND, "small").faults)
    assert parse(to_toml(extended), "written") == extended


def test_a_file_cannot_kill_a_process_that_is_down_already(tmp_path: Path) -> None:
    """Down by the scenario's own faults, which are in order."""
    own = mission(fault(kind="kill", who=["r1"], from_s=1, until_s=3))
    with pytest.raises(ScenarioError) as caught:
        with_chaos_file(
            tmp_path, "[[faults]]\nkind='kill'\nwho=['r2', 'r1']\nfrom_s=2\nuntil_s=4", own
        )

    assert str(caught.value) == (
        f"{tmp_path / 'chaos.toml'}: faults[0].who: r1 has a kill then already, "
        f"by the scenario's faults[0]; move one of the two"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "faults: missing; set it"),
        ("faults = []", "faults: expected `array` of length >= 1"),
        ("[radio]\ndrop = 0.5", "radio: no such key; known: faults"),
        ("[[fault]]\nkind='drop'", "fault: no such key; did you mean faults?"),
        ("[[faults]]\nkind='dorp'", "faults[0].kind: 'dorp' is not known; known: bandwidth"),
        ("[[faults]]\nkind='drop'\nprobabilty=1", "faults[0].probabilty: no such key; did you"),
        ("[[faults]]\nkind='partition'\nshape='x'", "faults[0].shape: 'x' is not known; known: ha"),
        ("[[faults]]\nkind='drop'\nprobability=1\nrobots=['r7']", "faults[0].robots: r7 is not"),
        ("[[faults]]\nkind='bandwidth'\nbytes_per_s=inf", "faults[0].bytes_per_s: inf is no usab"),
        ("[[faults", "not valid TOML: "),
    ],
)
def test_a_file_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    """Its own entries are counted, whatever faults the scenario has."""
    own = mission(fault(kind="drop", probability=0.5))
    with pytest.raises(ScenarioError) as caught:
        with_chaos_file(tmp_path, text, own)

    assert str(caught.value).startswith(f"{tmp_path / 'chaos.toml'}: {message}")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.toml", tmp_path):
        with pytest.raises(ScenarioError, match=str(path)):
            with_chaos(mission(), path)
    (tmp_path / "noise.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="not valid TOML"):
        with_chaos(mission(), tmp_path / "noise.toml")
