"""The same targets, guided by coverage. Needs atheris, which kantor does not.

    python tests/fuzz/guided.py TARGET [-runs=100000] [-max_total_time=60] [further options of libFuzzer]

For decoders that are Python: texts, maps, points, keys, credentials. Not for those whose good inputs come
of a mission, since numba cannot compile what is instrumented. It stops at the first input that breaks a rule.
"""

import sys
import tempfile
from pathlib import Path

import atheris

sys.path[0] = str(Path(__file__).resolve().parents[1])

_DECODERS = [
    *(
        f"kantor_protocol.{name}"
        for name in ("files", "scenario", "transport.credentials", "wire", "node.wal")
    ),
    *(
        f"kantor_worldsim.{name}"
        for name in (
            *("world.maps", "world.nav2", "world.pictures", "world.points", "world.density"),
            "record.journal",
        )
    ),
    *("kantor_fleet.sweep", "tomllib", "mcap"),
]

with atheris.instrument_imports(include=_DECODERS, enable_loader_override=False):
    from fuzz.targets import TARGETS


def main() -> None:
    """Begin with good and bad inputs of the target's own."""
    name, *options = sys.argv[1:]
    target = TARGETS[name]
    with tempfile.TemporaryDirectory() as folder:
        known, room = Path(folder) / "known", Path(folder) / "room"
        known.mkdir()
        room.mkdir()
        for i, content in enumerate(target.inputs().batch("guided", 500)):
            (known / str(i)).write_bytes(content)
        decode = target.start(room)
        atheris.Setup([sys.argv[0], *options, str(known)], lambda content: decode(content) and None)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
