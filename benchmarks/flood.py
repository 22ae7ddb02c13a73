"""Cost of a robot that floods the bus for the other robots, with and without the flood in one mission.

    python benchmarks/flood.py [--quick] [--beside]

A realtime mission with five robots on the real bus, four of them honest; `hostile_mission.py` says how it is
measured. Exits with 1 if a flood at least doubles the p99 of ticks, or memory grows.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import cycle

import numpy as np
from hostile_mission import MIB, Attack, Hostile, Tokens, mission_with, within
from tables import Table, show, verdict

from kantor_protocol.base.machine import Outputs, Pose
from kantor_protocol.wire.messages import VERSION, Report, encode

RATIO_MAX = 2.0
GROWTH_MAX_MIB = 32.0
SMALL_PER_S = 10_000
SMALL, LARGE = bytes(100), bytes(MIB)


@dataclass(frozen=True)
class Flood(Attack):
    """Messages of one length."""

    on: tuple[str, ...]
    """Kinds of keys."""
    payload: bytes | None
    """Bytes of a message; None: valid reports of a step that was reported long ago."""

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Put on the keys in turn."""
        old = encode(Report(VERSION, hostile.line.nonce, Outputs(0, Pose(0.0, 0.0))))
        payload = old if self.payload is None else self.payload
        put: list[Callable[[], object]] = [
            Tokens(hostile) if kind == "alive" else partial(hostile.send, payload, kind)
            for kind in self.on
        ]
        puts = cycle(put)

        def put_next() -> None:
            next(puts)()

        return put_next


FLOODS = (
    Flood("reports, 10,000/s", SMALL_PER_S, ("tx",), None),
    Flood("junk on tx, 10,000/s", SMALL_PER_S, ("tx",), SMALL),
    Flood("1 MiB on tx", float("inf"), ("tx",), LARGE),
    Flood("pose and weights, 10,000/s", SMALL_PER_S, ("pose", "weights"), SMALL),
    Flood("1 MiB on pose and weights", float("inf"), ("pose", "weights"), LARGE),
    Flood("1 MiB on tx, gigabit", 119, ("tx",), LARGE),
    Flood("tokens, 10,000/s", SMALL_PER_S, ("alive",), None),
)


def measure(*, quick: bool, beside: bool, floods: tuple[Flood, ...] = FLOODS) -> Table:
    """One mission for each flood."""
    rounds = 2 if quick else 5
    rows, met = [], True
    for flood in floods:
        measured = mission_with(flood, rounds, beside=beside)
        ticks = [tick for of_robot in measured.ticks.values() for tick in of_robot]
        calm, rough = within(ticks, measured.calm), within(ticks, measured.rough)
        p99s = [float(np.percentile(within(ticks, [w]), 99)) for w in measured.windows]
        ratio = float(np.median(np.divide(p99s[1::2], p99s[::2])))
        pair = (measured.calm, measured.rough)
        rss = [measured.peak_mib("worldsim", windows) for windows in pair]
        fine = ratio < RATIO_MAX and rss[1] - rss[0] < GROWTH_MAX_MIB
        met = met and fine
        rows.append(
            (
                flood.name,
                f"{measured.sent_per_s:,.0f}",
                f"{len(calm)}+{len(rough)}",
                f"{1e3 * np.median(calm):.1f}",
                f"{1e3 * np.median(rough):.1f}",
                f"{1e3 * np.median(p99s[::2]):.1f}",
                f"{1e3 * np.median(p99s[1::2]):.1f}",
                f"{ratio:.2f}",
                *(f"{100 * measured.cores(windows):.0f}" for windows in pair),
                *(f"{mib:.0f}" for mib in rss),
                verdict(met=fine),
            )
        )
        show(Table(flood.name, tuple("" for _ in rows[-1]), [rows[-1]]))
    return Table(
        f"flood: ticks of four honest robots, the flooder {'beside them' if beside else 'on its own core'}",
        (
            "flood", "sent/s", "ticks", "p50 ms", "flooded", "p99 ms", "flooded", "ratio",
            "cpu %", "flooded", "MiB", "flooded", "",
        ),
        rows,
        (
            "p99: the median over windows, ratio: over pairs of windows that follow each other",
            "cpu, MiB: of world-sim, which is the router",
        ),
        met,
    )  # fmt: skip


def main() -> int:
    """Measure and print; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description="What a flood costs the others.")
    parser.add_argument("--quick", action="store_true", help="shorter")
    parser.add_argument("--beside", action="store_true", help="the flooder competes for all cores")
    parser.add_argument("--only", type=int, help="one flood, from 0")
    options = parser.parse_args()
    floods = FLOODS if options.only is None else (FLOODS[options.only],)
    table = measure(quick=options.quick, beside=options.beside, floods=floods)
    show(table)
    return 0 if table.met else 1


if __name__ == "__main__":
    sys.exit(main())
