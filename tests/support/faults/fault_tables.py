"""Faults as TOML: a table of every kind, and one fault as an override."""

from typing import Any

EVERY_KIND = """
[[faults]]
kind = "drop"
probability = 0.25
robots = ["r1"]

[[faults]]
kind = "burst"
from_s = 1
until_s = 9.5
good_s = 2.0
bad_s = 0.5
drop_bad = 0.9

[[faults]]
kind = "delay"
delay_s = 0.2
jitter_s = 0.1

[[faults]]
kind = "duplicate"
probability = 1.0
copies = 3

[[faults]]
kind = "replay"
probability = 0.5
age_s = 3.0

[[faults]]
kind = "reorder"
probability = 0.5
hold_s = 1.0

[[faults]]
kind = "one-way"
senders = ["r1"]
receivers = ["r2", "r3"]

[[faults]]
kind = "partition"
shape = "groups"
groups = [["r1"], ["r2", "r3"]]
flap_s = 1.5

[[faults]]
kind = "clog"
until_s = 4.0

[[faults]]
kind = "bandwidth"
bytes_per_s = 1000.0
queue_bytes = 0

[[faults]]
kind = "range"
range_m = 12.0

[[faults]]
kind = "hostile"
probability = 0.1

[[faults]]
kind = "kill"
who = ["r1", "r2"]
from_s = 1.0
until_s = 2.0
disk = "torn"
mid_step = true

[[faults]]
kind = "pause"
who = ["r1"]
from_s = 2.0
until_s = 3.0

[[faults]]
kind = "late"
who = ["r3"]
until_s = 0.5

[[faults]]
kind = "slow"
who = ["r3"]
from_s = 4.0
every = 3

[[faults]]
kind = "full-disk"
who = ["r1", "r2"]
from_s = 5.0
until_s = 6.0

[[faults]]
kind = "clock"
who = ["r1", "r3"]
from_s = 0.5
offset_s = -3.0
rate_ppm = 100.0

[[faults]]
kind = "impostor"
who = ["r2"]
from_s = 3.0

[[faults]]
kind = "byzantine"
who = ["r2"]
lie = "fork"
from_s = 1.0
until_s = 7.0

[[faults]]
kind = "kill"
who = ["worldsim"]
from_s = 8.0
until_s = 9.0
"""


def fault(**values: Any) -> str:
    """One fault as `--set` takes it."""
    pairs = ", ".join(f"{key} = {value!r}" for key, value in values.items())
    return f"faults=[{{{pairs}}}]"
