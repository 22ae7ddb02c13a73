"""Variants of the small mission for tests of the checker, each as overrides of the scenario."""

Overrides = tuple[str, ...]

MERGES: dict[str, Overrides] = {
    "ledger": ("merge=ledger",),
    "min": ("merge=min", "claims=false"),
}
SPECTRAL = ("planner=spectral", "planner.modes=3")

RADIOS: dict[str, Overrides] = {
    "perfect": (),
    "short": ("radio.range_m=30", "supervisor.range_m=50"),
    "slow": ("radio.delay_s=0.25",),
    "lossy": (
        "radio.drop=0.3",
        "radio.duplicate=0.3",
        "radio.delay_s=0.03",
        "radio.jitter_s=0.2",
        "radio.reorder=0.3",
    ),
}
OUT_OF_RANGE = ("radio.range_m=0", "supervisor.range_m=0")
"""No robot hears another, so that a change of a record breaks no further rule."""

# Process faults, all but the impostor between 0.5 s and 1.1 s.

PAUSED = ("faults=[{kind = 'pause', who = ['r2'], from_s = 0.5, until_s = 1.1}]",)
DISK_FULL = ("faults=[{kind = 'full-disk', who = ['r2'], from_s = 0.5, until_s = 1.1}]",)
LATE = ("faults=[{kind = 'late', who = ['r2'], until_s = 1.1}]",)
KILLED = ("faults=[{kind = 'kill', who = ['r2'], from_s = 0.5, until_s = 1.1}]",)
DISK_LOST = ("faults=[{kind = 'kill', who = ['r2'], from_s = 0.5, until_s = 1.1, disk = 'lost'}]",)
DISK_TORN = (DISK_LOST[0].replace("lost", "torn"),)
KILLED_MID_STEP = (DISK_LOST[0].replace("disk = 'lost'", "mid_step = true"),)
WORLD_SIM_KILLED = ("faults=[{kind = 'kill', who = ['worldsim'], from_s = 0.5, until_s = 1.1}]",)
CLOCK_WRONG = (
    "faults=[{kind = 'clock', who = ['r2'], from_s = 0.5, until_s = 1.1, offset_s = 3.0}]",
)
HOSTILE = ("faults=[{kind = 'hostile', probability = 0.5, from_s = 0.5, until_s = 1.1}]",)
IMPOSTOR = ("faults=[{kind = 'impostor', who = ['r2'], from_s = 0.5}]",)

PROCESS_FAULTS = (
    PAUSED,
    DISK_FULL,
    LATE,
    KILLED,
    DISK_LOST,
    DISK_TORN,
    KILLED_MID_STEP,
    WORLD_SIM_KILLED,
    CLOCK_WRONG,
    HOSTILE,
    IMPOSTOR,
)
