"""Faults over the real bus."""

from typing import TYPE_CHECKING

import pytest

from support.processes.fleets import result_of

if TYPE_CHECKING:
    from support.processes.command import Kantor

STORM = """
[[faults]]
kind = "burst"
good_s = 2.0
bad_s = 0.5

[[faults]]
kind = "partition"
shape = "halves"
from_s = 2.0
until_s = 20.0

[[faults]]
kind = "delay"
from_s = 4.0
jitter_s = 0.4

[[faults]]
kind = "duplicate"
probability = 0.3
delay_s = 0.5

[[faults]]
kind = "replay"
probability = 0.2
age_s = 3.0

[[faults]]
kind = "clog"
from_s = 7.0
until_s = 30.0
"""
WIDE = ("--set", "radio.range_m=inf", "energy.points=2000", "samples.count=1000")


@pytest.fixture
def stormy(kantor: "Kantor") -> "Kantor":
    """The kantor command in a folder with a storm in it."""
    (kantor.folder / "storm.toml").write_text(STORM)
    return kantor


def test_a_storm_is_the_same_in_process_and_over_the_bus(stormy: "Kantor") -> None:
    """Every fault strikes as often, and every byte of the record is the same."""
    for exchange in ("in-process", "lockstep"):
        finished = stormy(
            "run", "fleet", "--exchange", exchange, "--chaos", "storm.toml", *WIDE,
            PYTHONHASHSEED="0" if exchange == "lockstep" else "7",
        )  # fmt: skip
        assert finished.code == 0, finished.out + finished.err

    here, there = (result_of(folder) for folder in stormy.runs())
    assert here["digest"] == there["digest"]
    assert here["faults"] == there["faults"]


def test_a_storm_in_real_time_breaks_no_rule(stormy: "Kantor") -> None:
    """Each robot on its own timer; the cut and the others hold by world-sim's clock."""
    finished = stormy(
        "run", "fleet", "--exchange", "wall", "--speed", 4, "--chaos", "storm.toml", *WIDE,
        "limit_s=100000",
    )  # fmt: skip
    assert finished.code == 0, finished.out + finished.err

    (folder,) = stormy.runs()
    result = result_of(folder)
    faults = result["faults"]
    assert isinstance(faults, dict)
    assert result["violations"] == 0
    assert all(any(counts.values()) for counts in faults.values()), faults
    assert stormy("verify", folder).code == 0
