"""How fast kantor is, measured in one go, as CPU time and as ratios to what was run beside it.

    python benchmarks/run.py [--quick] [--only SECTION] [--save FILE]

planner   CPU time of one planner step, beside the paper's algorithm taken to the letter in numpy
spectral  the same of multiscale coverage by its modes, and what its registers cost
routes    CPU time of the value function over a map, beside two other libraries
fleet     robot-steps that one CPU second buys when the whole fleet is in one process
maps      what missions on an unknown map cost, and what robots tell of the map
peers     the speed of other simulators, if they are installed
lockstep  ticks a second with a process for every robot, beside a bare Zenoh barrier
hub       robots times rate that one world-sim relays on the wall
wire      bytes that a robot publishes in a tick, beside its whole weight vector

Exits with 1 if a target is missed. Nothing is written unless --save names a file.
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

SECTIONS = ("planner", "spectral", "routes", "fleet", "maps", "peers", "lockstep", "hub", "wire")
LIBRARIES = ("kantor", "eclipse-zenoh", "numpy", "numba", "msgspec")


def main() -> int:
    """Measure, print, save; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description="How fast kantor is.")
    parser.add_argument("--quick", action="store_true", help="fewer sizes and shorter runs")
    parser.add_argument("--only", choices=SECTIONS, help="one section")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the tables as JSON")
    options = parser.parse_args()
    machine = _machine()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    tables: dict[str, Table] = {}
    for name in (options.only,) if options.only else SECTIONS:
        # A section imports what it measures; the others' children need none of it.
        tables[name] = import_module(f"{name}_speed").measure(quick=options.quick)
        show(tables[name])
    if options.save is not None:
        tree = {"machine": machine, "quick": options.quick}
        tree |= {name: table._asdict() for name, table in tables.items()}
        options.save.write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")
    return 0 if all(table.met for table in tables.values()) else 1


def _machine() -> dict[str, Any]:
    """What the figures depend on."""
    return {
        "cores": len(os.sched_getaffinity(0)),
        "load": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
    }


if __name__ == "__main__":
    sys.exit(main())
