"""Speed of kantor: CPU times, and ratios to references measured in the same run.

    python benchmarks/run.py [--quick] [--only SECTION] [--save FILE]

planner   CPU time of one planner step, beside the literal algorithm of the paper in numpy
spectral  the same for multiscale coverage, by its modes, and the cost of its registers
routes    CPU time of the value function over a map, beside two other libraries
fleet     robot-steps that one CPU second buys when the whole fleet is in one process
maps      cost of missions on an unknown map, and bytes that robots publish of it
peers     the speed of other simulators, if they are installed
lockstep  ticks a second with a process for every robot, beside a bare Zenoh barrier
hub       robots times rate that one world-sim relays in realtime
wire      bytes that a robot publishes in a tick, beside its whole weight vector
scale     time, bytes and memory of missions by their size: robots, processes, samples, simulated time
signing   bytes and CPU time that signed attestations take, beside the same missions without

A target is a ratio within the run, and stands beside its figure; one that is missed is marked MISS, and its section is
named in the end. Nothing is written unless --save names a file.
"""

import argparse
import json
import os
import platform
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tables import Table, show

SECTIONS = (
    "planner",
    "spectral",
    "routes",
    "fleet",
    "maps",
    "peers",
    "lockstep",
    "hub",
    "wire",
    "scale",
    "signing",
)
LIBRARIES = ("kantor", "eclipse-zenoh", "numpy", "numba", "msgspec")


def main() -> int:
    """Measure, print, save."""
    parser = argparse.ArgumentParser(description="How fast kantor is.")
    parser.add_argument("--quick", action="store_true", help="fewer sizes and shorter runs")
    parser.add_argument("--only", choices=SECTIONS, help="one section")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the tables as JSON")
    options = parser.parse_args()
    machine = _machine()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    tables: dict[str, Table] = {}
    for name in (options.only,) if options.only else SECTIONS:
        # Each section imports only what it measures; child processes of others do without it.
        tables[name] = import_module(f"{name}_speed").measure(quick=options.quick)
        show(tables[name])
    if options.save is not None:
        tree = {"machine": machine, "quick": options.quick}
        tree |= {name: table._asdict() for name, table in tables.items()}
        options.save.write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")
    missed = [name for name, table in tables.items() if not table.met]
    print(f"\ntargets missed: {', '.join(missed) or 'none'}")
    return 0


def _machine() -> dict[str, Any]:
    """The machine and the versions on which the figures depend."""
    return {
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
    }


if __name__ == "__main__":
    sys.exit(main())
