"""Every decoder, each with the one rule that bad input must keep to.

A target takes an input and says whether it was taken in (True) or refused (False). It raises for whatever
must not be: another exception than the documented one, a state that a refused message has changed, an
answer that contradicts the input, a kernel that read or wrote beyond its arrays.
"""

import functools
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import msgspec
import numpy as np

from fuzz import corpora
from fuzz.mutations import unframe
from kantor_fleet.execution.experiment import Outcome
from kantor_fleet.execution.in_process_team import participant
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey, SweepError
from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN
from kantor_protocol.base.machine import Body, Envelope, Inputs, Observation, Pose, StateMachine
from kantor_protocol.base.varint import Pairs, pack_pairs, sum_pairs
from kantor_protocol.node import wal as wal_module
from kantor_protocol.node.recovery import RecoverableNode, WalContents
from kantor_protocol.node.wal import WalFile
from kantor_protocol.replication.gossip import build_replica
from kantor_protocol.replication.occupancy_log import OccupancyLog, entries
from kantor_protocol.replication.registers import NUMBER_MAX, read_register
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.dump import to_toml, to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import from_tree, parse, with_chaos
from kantor_protocol.transport import credentials
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import (
    Array,
    Mission,
    RefusedError,
    check_outputs,
    decode_from_participant,
    decode_gossip,
    decode_inputs,
    decode_progress,
    decode_to_participant,
    encode,
    encode_gossip,
)
from kantor_protocol.wire.version_vector import read_version_vector
from kantor_protocol.wire.weights import Units, WeightsSubscriber
from kantor_worldsim.record import columnar
from kantor_worldsim.record.columnar import (
    ALL_HEARD,
    ALL_SENT,
    DECISIONS,
    INJECTED,
    PAIRS,
    STEP_RECORDS,
)
from kantor_worldsim.record.journal import read as read_journal
from kantor_worldsim.record.records import decode_record, encode_record
from kantor_worldsim.world import density, maps
from kantor_worldsim.world.world import units_of
from support.missions import on_map
from support.strategies import mission

Decode = Callable[[bytes], bool]


class Corpus(Protocol):
    """A corpus: makes the inputs of a target."""

    def batch(self, name: object, count: int) -> list[bytes]:
        """Return `count` inputs; the same ones for the same name."""
        ...


class Target(NamedTuple):
    """A decoder under test."""

    inputs: Callable[[], Corpus]
    start: Callable[[Path], Decode]
    """Returns a fresh decoder, called at the start of each batch. The folder is for its files."""
    in_kernels: bool = False
    """Whether compiled code reads the bytes: coverage cannot guide the search there."""


def _same(decode: Decode) -> Callable[[Path], Decode]:
    """A decoder without state."""
    return lambda _folder: decode


def _refuses(error: type[Exception], decode: Callable[[bytes], object]) -> Decode:
    """A refused input raises this error, with one line."""

    def attempt(content: bytes) -> bool:
        try:
            decode(content)
        except error as refusal:
            return not _in_one_line(refusal)
        return True

    return attempt


def _in_one_line(refusal: Exception) -> bool:
    text = str(refusal)
    assert text, "a refusal without a word"
    assert "\n" not in text or not isinstance(refusal, ScenarioError), "a refusal in two lines"
    return True


# Messages.


def _news(content: bytes) -> None:
    news = decode_gossip(content)
    assert decode_gossip(encode_gossip(news)) == news, "news that changes on the way"


def _from_participant(content: bytes) -> None:
    message = decode_from_participant(content)
    assert decode_from_participant(encode(message)) == message, "a message that changes on the way"


def _to_participant(content: bytes) -> None:
    message = decode_to_participant(content)
    if isinstance(message, Mission):
        message.starts.open("<f8", 2)
        message.samples.open("<f8", 2)


_ARRAY = msgspec.msgpack.Decoder(Array)


def _array(content: bytes) -> bool:
    try:
        array = _ARRAY.decode(content)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False  # the messages' business
    for dtype, dimensions in (("<f8", 2), ("u1", 2), ("<f8", 1)):
        try:
            opened = array.open(dtype, dimensions)
        except RefusedError:
            continue
        assert opened.ndim == dimensions
        assert opened.nbytes == len(array.content)
        return True
    return False


def _record(content: bytes) -> bool:
    try:
        record = decode_record(content)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False
    again = encode_record(record)
    assert encode_record(decode_record(again)) == again, "a record that changes on the way"
    return True


def _weights(_folder: Path) -> Decode:
    subscriber = WeightsSubscriber()

    def take(content: bytes) -> bool:
        before = subscriber.weights
        taken = subscriber.apply(content)
        assert taken or subscriber.weights is None or subscriber.weights is before
        assert not taken or (subscriber.weights is not None and subscriber.weights.min() >= 0)
        return taken

    return take


# What is packed.


def _pairs(_folder: Path) -> Decode:
    pairs = Pairs()
    out = np.zeros(1 << 17, dtype=np.uint8)

    def decode(content: bytes) -> bool:
        (packed,) = unframe(content)
        total = sum_pairs(packed, 12)
        found = pairs.decode(packed, 12)
        if found is None:
            assert total < 0
            return False
        index, value = found
        assert ((index >= 0) & (index < 12)).all()
        used = pack_pairs(index, value, index.shape[0], out)
        again = pairs.decode(out[:used].tobytes(), 12)
        assert again is not None
        assert sum(again[1].tolist()) == total or total < 0
        return True

    return decode


def _learning(name: str, me: str = "r1", samples: int | None = None) -> Callable[[Path], Decode]:
    """A replica merges a message; a refused one changes nothing."""

    def start(_folder: Path) -> Decode:
        played = corpora.played(name)
        scenario = played.scenario
        if scenario.mapping:
            assert played.setup.ground is not None
            bound, units = entries(played.setup.ground.frame), None
        else:
            bound, units = played.setup.samples_m.shape[0], units_of(scenario, 12)
        replica = build_replica(me, scenario, units, bound)
        registers = replica.registers

        def take(content: bytes) -> bool:
            source, version_vector, logs, claims, written = unframe(content)
            place = source[0] % (3 * len(scenario.roster)) if source else 0
            before = _state(replica)
            taken = replica.merge(place, version_vector, logs, claims, written)
            if not taken:
                assert _state(replica) == before, "a refused message has changed something"
                return False
            _is_sound(replica)
            assert (registers.values.sum(axis=0) == registers.total).all()
            return True

        return take

    return start


def _state(replica: Replica) -> list[bytes]:
    """The contents of a replica, without the capacity of its arrays."""
    store, registers = replica.store, replica.registers
    arrays = (
        *(store.weights, store.length, store.known, store.sending, store.claims),
        *(store.lowered, store.mark, store.counters),
        *(registers.values, registers.total, registers.stamps),
        *(registers._known, registers._received, registers._updated, registers._sent),
    )
    return [array.tobytes() for array in arrays]


def _is_sound(replica: Replica) -> None:
    store, config = replica.store, replica.config
    rows, capacity, _ = store.logs.shape
    written = store.length if config.ledger else store.length[config.me : config.me + 1]
    assert (written >= 0).all(), "a log of negative length"
    assert (written <= capacity).all(), "a log longer than its room"
    assert rows == (store.length.shape[0] if config.ledger else 1)
    if store.weights.size:
        assert store.weights.min() >= 0, "a negative weight"
        assert store.counters[2] == np.count_nonzero(store.weights), "weights are not counted"


def _registers(_folder: Path) -> Decode:
    """Registers are decoded and merged without a replica; what was merged can be read."""
    scenario = mission(*corpora.SHORT, *corpora.DENSITY["spectral"])
    registers = build_replica("r1", scenario, Units.of(30, 12), 12).registers
    width = registers.values.shape[1]

    def take(content: bytes) -> bool:
        source, written = unframe(content)
        sound = registers.is_well_formed(written, 3)
        if sound:
            registers.merge(source[0] % 3 if source else 0, written, 3)
            assert (registers.values.sum(axis=0) == registers.total).all()
            assert np.abs(registers.values).max() <= NUMBER_MAX
        for origin in range(3):
            found = read_register(written, 3, width, origin)
            assert found is not None or not sound, "a sound register that cannot be read"
        return sound

    return take


def _register_inputs() -> Corpus:
    from fuzz.mutations import LEB_TOKENS, Framed, pick

    told = [
        decode_gossip(body)
        for name in ("spectral", "market")
        for body in pick(corpora.played(name).bodies(), corpora.GOODS, 1500)
    ]
    return Framed([(bytes((i % 3,)), n.registers) for i, n in enumerate(told)], LEB_TOKENS)


def _reading_have(content: bytes) -> bool:
    _source, version_vector, *_ = unframe(content)
    lengths = read_version_vector(version_vector, 3)
    assert lengths is None or min(lengths) >= 0
    return lengths is not None


def _evidence(_folder: Path) -> Decode:
    scenario = on_map(*corpora.MAP["burgard"])
    frame = corpora.played("burgard").opening.frame
    assert frame is not None
    evidence = OccupancyLog(frame, scenario.sensor, ranges=True)
    bound = entries(frame)

    def take(content: bytes) -> bool:
        scan, place = unframe(content)
        x_m, y_m, heading_rad = struct.unpack("<3d", place[:24].ljust(24, b"\0"))
        news = evidence.observe(scan, Pose(x_m, y_m, heading_rad), moved=True)
        if news.size:
            assert 0 <= news.min() <= news.max() < bound
        assert evidence.kinds.max() <= OCCUPIED
        assert not evidence._votes.any(), "votes that stay"
        return news.size > 0

    return take


# Referees.


def _reader(_folder: Path) -> Decode:
    """The kernel that fills a decoder's tables, on any bytes and with too few rows."""
    tables = columnar.ColumnarDecoder()
    tables._make_room(64)
    sizes = tables._tables[0]

    def read(content: bytes) -> bool:
        at = columnar._read_batch(content, *tables._tables, tables._pose_bits, 3, 3, 12)
        assert at <= len(content), "read beyond the end"
        if at >= 0:
            counts = sizes[
                [STEP_RECORDS, STEP_RECORDS, ALL_HEARD, ALL_SENT, DECISIONS, PAIRS, INJECTED]
            ].tolist()
            for table, rows in zip(tables._tables[1:], counts, strict=True):
                assert 0 <= rows <= table.shape[0]
        return at >= 0

    return read


def _parts_of_news(content: bytes) -> bool:
    incarnation, version_vector, have_end, logs, end = columnar.parts_of_gossip(
        content, 0, len(content)
    )
    assert end <= len(content)
    try:
        news = decode_gossip(content)
    except RefusedError:
        assert end < 0, "a referee takes for news what robots refuse"
        return False
    if end >= 0:
        assert incarnation == news.incarnation
        assert (content[version_vector:have_end], content[logs:end]) == (
            news.version_vector,
            news.logs,
        )
    return end >= 0


def _parts_of_weights(content: bytes) -> bool:
    *_, low, high = columnar.parts_of_weights(content, 0, len(content))
    assert high <= len(content)
    assert high < 0 or low <= high
    return high >= 0


# Machines.


def _newborn(me: str, played: corpora.Played) -> StateMachine:
    scenario, setup = played.scenario, played.setup
    return participant(me, scenario, 1, setup, Body(setup.poses(scenario)[me]))


def _machine(name: str, me: str) -> Callable[[Path], Decode]:
    """A whole participant receives an envelope in each step."""

    def start(_folder: Path) -> Decode:
        played = corpora.played(name)
        machine = _newborn(me, played)
        pose, step, refused = Pose(1.5, 1.5), 0, 0
        inputs = [i for i, who in zip(played.inputs, played.acted, strict=True) if who == me]
        scan = inputs[0].observation.scan

        def take(content: bytes) -> bool:
            nonlocal pose, step, refused
            other = "r2" if me != "r2" else "r1"
            inbox = (Envelope(other, step, "", content),)
            observation = Observation(step, pose, (), scan)
            outputs = machine.step(Inputs(step * played.scenario.period_ns, observation, inbox))
            check_outputs(outputs)
            taken = outputs.refused == refused
            assert refused <= outputs.refused <= refused + 1
            pose, step, refused = outputs.pose, outputs.step, outputs.refused
            return taken

        return take

    return start


class _OneEntryLog:
    """A write-ahead log of one entry."""

    def __init__(self, page: bytes) -> None:
        self._page = page

    def read(self) -> WalContents:
        """Return the entry."""
        return WalContents(Body(Pose(10.0, 10.0)), (self._page,))

    def reset(self, initial_state: Body) -> None:
        """Fail: nothing is written here."""
        raise AssertionError("a log that covers all is thrown away")

    def append(self, inputs: bytes) -> None:
        """Drop the entry."""


def _recovery(name: str, me: str) -> Callable[[Path], Decode]:
    """A node recovers from an entry that was tampered with."""

    def start(_folder: Path) -> Decode:
        played = corpora.played(name)
        machine = _newborn(me, played)

        def live(content: bytes) -> None:
            RecoverableNode(lambda _body: machine, _OneEntryLog(content), Body(Pose(10.0, 10.0)))

        return _refuses(RefusedError, live)

    return start


def _wal(folder: Path, *, framed: bool) -> Decode:
    """A write-ahead log on disk: its sound beginning is read, and every entry can be stepped through.

    framed: length and checksum of every frame are right, whatever is in it.
    """
    path = folder / "wal"

    def read(content: bytes) -> bool:
        path.write_bytes(_in_frames(unframe(content)) if framed else content)
        wal = WalFile(path, "run")
        try:
            pages = wal.read()
        finally:
            wal.close()
        for page in pages.inputs if pages else ():
            decode_inputs(page)
        return pages is not None

    return read


def _in_frames(parts: tuple[bytes, ...]) -> bytes:
    content, crc = wal_module._MAGIC, zlib.crc32(wal_module._MAGIC)
    for part in parts[:-1]:
        frame, crc = wal_module._frame(part, crc)
        content += frame
    return content + parts[-1]


# Texts and files.


def _parse(content: bytes) -> None:
    scenario = parse(content.decode("utf-8", "surrogateescape"), "any")
    assert parse(to_toml(scenario), "written") == scenario, "a scenario that changes when written"


def _override(content: bytes) -> None:
    from support.strategies import SMALL

    parse(SMALL, "small", [content.decode("utf-8", "surrogateescape")])


class Trees:
    """TOML trees with values and keys replaced, as msgpack."""

    def __init__(self) -> None:
        self._trees = [to_tree(parse(text, "good")) for text in corpora.texts_of_scenarios()]
        self._values: list[Any] = [
            *(0, 1, -1, 2, 3, 1000, 2**62, 2**64 - 1, 0.0, -0.5, 0.5, 1e-9, 1e300, True, False),
            *(float("nan"), float("inf"), -float("inf"), "", "r1", "r9", "supervisor", "worldsim"),
            *("min", "ledger", "turn", "dubins", "a.csv", "c.txt", "kill", "drop", "é\n", [], {}),
            *([[0.0, 0.0]], [1.0, 2.0], ["r1"], ["r1", "r1"], ["r9"], [{}], [[]], [None], None),
            *({"name": "spectral"}, {"kind": "kill", "who": ["r2"], "from_s": 1.0, "until_s": 1.5}),
            *(
                {"kind": "late", "who": ["r1", "r2"], "until_s": 2.0},
                {"kind": "impostor", "who": ["r1"]},
            ),
        ]
        names = {key for tree in self._trees for key in _keys_in(tree)}
        self._keys = sorted(names | {"x", "", "kind", "until_s", "a\nb", "mapp", "probabilty"})

    def batch(self, name: object, count: int) -> list[bytes]:
        """Return `count` inputs; the same ones for the same name."""
        import random

        draw = random.Random(str(name))
        return [self._one(draw.random) for _ in range(count)]

    def _one(self, draw: Callable[[], float]) -> bytes:
        tree = msgspec.msgpack.decode(self._packed(int(draw() * len(self._trees))))
        for _ in range(1 if draw() < 0.6 else 3):
            self._change(tree, draw)
        return msgspec.msgpack.encode(tree)

    @functools.cache  # noqa: B019  there is one of it
    def _packed(self, i: int) -> bytes:
        return msgspec.msgpack.encode(self._trees[i])

    def _change(self, tree: Any, draw: Callable[[], float]) -> None:
        """Replace a value, add or remove a key, or repeat a row."""
        while True:
            among = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
            if not among:
                return
            key = among[int(draw() * len(among))]
            if isinstance(tree[key], dict | list) and draw() < 0.75 and tree[key]:
                tree = tree[key]
                continue
            break
        chance = draw()
        value = self._values[int(draw() * len(self._values))]
        if isinstance(value, dict | list):
            value = msgspec.msgpack.decode(msgspec.msgpack.encode(value))
        if chance < 0.55:
            tree[key] = value
        elif chance < 0.7:
            del tree[key]
        elif isinstance(tree, dict):
            tree[self._keys[int(draw() * len(self._keys))]] = value if chance < 0.9 else tree[key]
        else:
            tree.append(tree[key] if chance < 0.85 else value)


def _keys_in(tree: Any) -> Iterable[str]:
    for key, value in tree.items() if isinstance(tree, dict) else ():
        yield key
        yield from _keys_in(value)
    for value in tree if isinstance(tree, list) else ():
        yield from _keys_in(value)


def _tree(content: bytes) -> None:
    from_tree(msgspec.msgpack.decode(content), "any")


def _storm(folder: Path) -> Decode:
    path, own = folder / "storm.toml", mission(*corpora.SHORT)

    def read(content: bytes) -> None:
        path.write_bytes(content)
        with_chaos(own, path)

    return _refuses(ScenarioError, read)


def _key(content: bytes) -> bool:
    text = content.decode("utf-8", "surrogateescape")
    key = keys.parse(text)
    if key is not None:
        fleet, name, kind, nonce = key
        again = "/".join(("kantor/v1", fleet, name, kind, *((nonce,) if nonce else ())))
        assert again in (text, text.removesuffix("/"))
    return key is not None


def _identity(folder: Path) -> Decode:
    path = folder / "r1.toml"

    def read(content: bytes) -> None:
        path.write_bytes(content)
        assert credentials.find(path, "r1").user == "r1"

    return _refuses(credentials.CredentialsError, read)


class _InMemory:
    """A path whose file is in memory."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def open(self, _mode: str) -> BytesIO:
        """Open the bytes for reading."""
        return BytesIO(self._content)


def _journal(content: bytes) -> bool:
    found = list(read_journal(cast("Path", _InMemory(content))))
    return len(found) > 0


def runs_of_sweeps() -> Sequence[bytes]:
    """A file of runs, whole or torn."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "runs.jsonl"
        with RunsJournal(path) as journal:
            for seed in range(2):
                journal.add(RunKey("ab", "cd", seed, False), Outcome(failed="nothing", wall_s=0.5))
        content = path.read_bytes()
    return (content, content[:-9])


def _runs(folder: Path) -> Decode:
    path = folder / "runs.jsonl"

    def read(content: bytes) -> None:
        path.write_bytes(content)
        with RunsJournal(path) as journal:
            assert all(isinstance(known, Outcome) for known in journal.outcomes.values())

    return _refuses(SweepError, read)


def _map(suffix: str) -> Callable[[Path], Decode]:
    def start(folder: Path) -> Decode:
        path = folder / f"map{suffix}"
        if suffix == ".yaml":
            (folder / "map.pgm").write_bytes(b"P5\n2 2\n255\n\xfe\x00\xcd\xfe")

        def read(content: bytes) -> None:
            path.write_bytes(content)
            ground, _ = maps.read(path)
            rows, columns = ground.cells.shape
            assert (ground.frame.rows, ground.frame.columns) == (rows, columns)
            assert set(np.unique(ground.cells).tolist()) <= {UNKNOWN, FREE, OCCUPIED}

        return _refuses(ScenarioError, read)

    return start


def _points(suffix: str) -> Callable[[Path], Decode]:
    def start(folder: Path) -> Decode:
        path = folder / f"points{suffix}"
        scenario = mission(*corpora.SHORT, f"samples.file={path}")

        def read(content: bytes) -> None:
            path.write_bytes(content)
            points = density.samples_of(scenario, 1)
            assert points.ndim == 2
            assert np.isfinite(points).all()

        return _refuses(ScenarioError, read)

    return start


TARGETS: dict[str, Target] = {
    "news": Target(corpora.news, _same(_refuses(RefusedError, _news))),
    "inputs": Target(corpora.inputs, _same(_refuses(RefusedError, decode_inputs))),
    "from-participant": Target(
        corpora.from_participants, _same(_refuses(RefusedError, _from_participant))
    ),
    "to-participant": Target(
        corpora.to_participants, _same(_refuses(RefusedError, _to_participant))
    ),
    "progress": Target(corpora.progress, _same(_refuses(RefusedError, decode_progress))),
    "array": Target(corpora.arrays, _same(_array)),
    "record": Target(corpora.records, _same(_record)),
    "weights": Target(corpora.weights, _weights, in_kernels=True),
    "pairs": Target(corpora.packed, _pairs, in_kernels=True),
    "learn-ledger": Target(lambda: corpora.news_fields("ledger"), _learning("ledger"), True),
    "learn-min": Target(lambda: corpora.news_fields("min"), _learning("min"), True),
    "learn-relay": Target(
        lambda: corpora.news_fields("centralized"), _learning("centralized", "supervisor"), True
    ),
    "learn-registers": Target(lambda: corpora.news_fields("spectral"), _learning("spectral"), True),
    "learn-map": Target(lambda: corpora.news_fields("market"), _learning("market"), True),
    "learn-reborn": Target(lambda: corpora.news_fields("reborn"), _learning("reborn"), True),
    "registers": Target(_register_inputs, _registers, True),
    "read-have": Target(lambda: corpora.news_fields("ledger"), _same(_reading_have), True),
    "evidence": Target(corpora.scans, _evidence, True),
    "reader": Target(corpora.batches, _reader, True),
    "parts-of-news": Target(corpora.news, _same(_parts_of_news), True),
    "parts-of-weights": Target(corpora.weights, _same(_parts_of_weights), True),
    "robot": Target(lambda: corpora.news("ledger"), _machine("ledger", "r1"), True),
    "reborn": Target(lambda: corpora.news("reborn"), _machine("reborn", "r2"), True),
    "supervisor": Target(
        lambda: corpora.news("centralized"), _machine("centralized", "supervisor"), True
    ),
    "mapper": Target(lambda: corpora.news("market"), _machine("market", "r1"), True),
    "allocation": Target(
        lambda: corpora.news("allocated"), _machine("allocated", "supervisor"), True
    ),
    "life": Target(corpora.inputs, _recovery("ledger", "r1"), True),
    "life-on-map": Target(corpora.inputs, _recovery("burgard", "r1"), True),
    "wal": Target(corpora.wals, partial(_wal, framed=True)),
    "wal-file": Target(corpora.wal_files, partial(_wal, framed=False)),
    "scenario-tree": Target(Trees, _same(_refuses(ScenarioError, _tree))),
    "scenario-text": Target(corpora.scenarios, _same(_refuses(ScenarioError, _parse))),
    "chaos-file": Target(corpora.storms, _storm),
    "override": Target(corpora.overrides, _same(_refuses(ScenarioError, _override))),
    "keys": Target(corpora.keys, _same(_key)),
    "credentials": Target(corpora.identities, _identity),
    "journal": Target(corpora.journals, _same(_journal)),
    "runs-of-sweep": Target(corpora.logs_of_runs, _runs),
    "map-nav2": Target(corpora.nav2, _map(".yaml")),
    "map-movingai": Target(corpora.moving_ai, _map(".map")),
    "map-pgm": Target(lambda: corpora.pictures("PPM"), _map(".pgm")),
    "map-png": Target(lambda: corpora.pictures("PNG", "BMP"), _map(".png")),
    "map-tiff": Target(lambda: corpora.pictures("TIFF", "JPEG"), _map(".tiff")),
    "points-csv": Target(corpora.tables_of_points, _points(".csv")),
    "points-npy": Target(corpora.arrays_in_files, _points(".npy")),
    "points-image": Target(lambda: corpora.pictures("PNG", "PPM"), _points(".png")),
}
