"""What `kantor chaos docker` takes from a file, in which order, and what it refuses; no engine is needed."""

import msgspec
import pytest

from kantor_fleet.processes.chaos import ContainerCommand, commands_of
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.schedule import Chaos


def faults(*entries: dict[str, object]) -> tuple[Fault, ...]:
    return msgspec.convert({"faults": entries}, Chaos).faults


def test_commands_come_in_order_and_ends_before_beginnings() -> None:
    """A pause that follows a cut at the same moment."""
    deeds = commands_of(
        faults(
            {"kind": "pause", "who": ["r1"], "from_s": 9, "until_s": 12},
            {"kind": "partition", "shape": "isolate", "robots": ["r1"], "from_s": 3, "until_s": 9},
            {"kind": "kill", "who": ["worldsim"], "from_s": 5, "until_s": 6},
            {"kind": "kill", "who": ["r2"], "from_s": 10},
        )
    )

    assert [(deed.at_s, deed.who, deed.action) for deed in deeds] == [
        (3, "r1", "cut"),
        (5, "worldsim", "kill"),
        (6, "worldsim", "start"),
        (9, "r1", "join"),
        (9, "r1", "pause"),
        (10, "r2", "kill"),
        (12, "r1", "unpause"),
    ]
    assert deeds[0] == ContainerCommand(3.0, undoes=False, action="cut", who="r1", fault=1)


@pytest.mark.parametrize(
    "entry",
    [
        {"kind": "drop", "probability": 0.1},
        {"kind": "kill", "who": ["r1"], "disk": "lost", "until_s": 3},
        {"kind": "kill", "who": ["r1"], "mid_step": True},
        {"kind": "partition", "shape": "halves"},
    ],
)
def test_faults_that_no_engine_can_inject_are_refused(
    entry: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line that says what it can."""
    with pytest.raises(SystemExit) as refused:
        commands_of(faults(entry))

    assert refused.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"kantor: faults[0]: a {entry['kind']} like this is not for containers")
