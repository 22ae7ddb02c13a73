"""Decoders of texts and files: scenarios, keys, credentials, runs of sweeps, maps and points."""

import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from fuzz import corpora
from fuzz.decoding import Decode, refuses
from kantor_fleet.execution.experiment import Outcome
from kantor_fleet.execution.verify import inputs_in, read_manifest
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import SweepError
from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN
from kantor_protocol.files.toml import parse_toml
from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import from_tree, load, parse, with_chaos
from kantor_protocol.transport import credentials
from kantor_protocol.wire import keys
from kantor_worldsim.record.run_folder import MANIFEST, Past, ResumeError
from kantor_worldsim.world import density, maps
from kantor_worldsim.world.inputs import inputs_of
from support.missions import on_map
from support.strategies import SMALL, mission


def scenario_text(content: bytes) -> None:
    """A scenario that is read and written stays as it is."""
    scenario = parse(content.decode("utf-8", "surrogateescape"), "any")
    assert parse(to_toml(scenario), "written") == scenario, "a scenario that changes when written"


def override(content: bytes) -> None:
    """One `--set` of a small scenario."""
    parse(SMALL, "small", [content.decode("utf-8", "surrogateescape")])


def scenario_tree(content: bytes) -> None:
    """A scenario as a tree, packed with msgpack."""
    from_tree(msgspec.msgpack.decode(content), "any")


def toml_text(content: bytes) -> None:
    """TOML that is read is the same as without the guard."""
    text = content.decode("utf-8", "surrogateescape")
    assert repr(parse_toml(text)) == repr(tomllib.loads(text))


def scenario_file(folder: Path) -> Decode:
    """The file of a scenario, whose names of files are absolute and text."""
    path = folder / "scenario.toml"

    def read(content: bytes) -> None:
        path.write_bytes(content)
        scenario = load(path)
        for file in inputs_of(scenario):
            assert file.path.is_absolute()
            assert file.name.encode()

    return refuses(ScenarioError, read)


def inputs_of_map(folder: Path) -> Decode:
    """The inputs of a map's file are listed, whatever is in it."""
    path = folder / "map.yaml"
    scenario = on_map(f"map={{file='{path}'}}")

    def read(content: bytes) -> bool:
        path.write_bytes(content)
        first, *image = inputs_of(scenario)
        assert first.key == "map.file"
        assert first.blake2b is not None
        return bool(image)

    return read


def manifest(folder: Path) -> Decode:
    """The manifest of a run: verified, and gone on from."""

    def read(content: bytes) -> None:
        (folder / MANIFEST).write_bytes(content)
        with suppress(ResumeError):
            Past.of(folder)
        try:
            inputs_in(read_manifest(folder))
        except SystemExit:
            raise ScenarioError("refused") from None

    return refuses(ScenarioError, read)


def chaos_file(folder: Path) -> Decode:
    """A file of faults for a small scenario."""
    path, own = folder / "chaos.toml", mission(*corpora.SHORT)

    def read(content: bytes) -> None:
        path.write_bytes(content)
        with_chaos(own, path)

    return refuses(ScenarioError, read)


def key_expression(content: bytes) -> bool:
    """A key expression has the parts of which it is made."""
    text = content.decode("utf-8", "surrogateescape")
    key = keys.parse(text)
    if key is not None:
        fleet, name, kind, nonce = key
        again = "/".join(("kantor/v1", fleet, name, kind, *((nonce,) if nonce else ())))
        assert again in (text, text.removesuffix("/"))
    return key is not None


def identity_file(folder: Path) -> Decode:
    """The identity file of r1."""
    path = folder / "r1.toml"

    def read(content: bytes) -> None:
        path.write_bytes(content)
        assert credentials.find(path, "r1").user == "r1"

    return refuses(credentials.CredentialsError, read)


def runs_of_sweep(folder: Path) -> Decode:
    """The finished runs in the file of a sweep."""
    path = folder / "runs.jsonl"

    def read(content: bytes) -> None:
        path.write_bytes(content)
        with RunsJournal(path) as journal:
            assert all(isinstance(known, Outcome) for known in journal.outcomes.values())

    return refuses(SweepError, read)


def map_file(suffix: str) -> Callable[[Path], Decode]:
    """A map has cells of the three kinds, as many as its frame says."""

    def start(folder: Path) -> Decode:
        path = folder / f"map{suffix}"
        if suffix == ".yaml":
            (folder / "map.pgm").write_bytes(b"P5\n2 2\n255\n\xfe\x00\xcd\xfe")

        def read(content: bytes) -> None:
            path.write_bytes(content)
            ground, warnings = maps.read(path)
            assert not any("\n" in line for line in warnings)
            rows, columns = ground.cells.shape
            assert (ground.frame.rows, ground.frame.columns) == (rows, columns)
            assert set(np.unique(ground.cells).tolist()) <= {UNKNOWN, FREE, OCCUPIED}

        return refuses(ScenarioError, read)

    return start


def points_file(suffix: str) -> Callable[[Path], Decode]:
    """Points are finite."""

    def start(folder: Path) -> Decode:
        path = folder / f"points{suffix}"
        scenario = mission(*corpora.SHORT, f"samples.file={path}")

        def read(content: bytes) -> None:
            path.write_bytes(content)
            points = density.samples_of(scenario, 1)
            assert points.ndim == 2
            assert np.isfinite(points).all()

        return refuses(ScenarioError, read)

    return start
