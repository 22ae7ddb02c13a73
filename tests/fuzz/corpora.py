"""Good inputs, made by the code itself: what small missions send, record and write."""

import functools
import tempfile
from collections.abc import Callable, Iterable, Iterator
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from fuzz.mutations import (
    LEB_TOKENS,
    MSGPACK_TOKENS,
    Framed,
    Good,
    Grammar,
    Mutations,
    Span,
    even_spans,
    msgpack_spans,
    number_spans,
    pick,
    text_spans,
)
from kantor_fleet.execution.experiment import Outcome
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.security import authority
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey
from kantor_protocol.base.machine import Body, Inputs, Outputs, Pose
from kantor_protocol.node.wal import WalFile
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport import credentials
from kantor_protocol.wire.messages import (
    VERSION,
    Array,
    Mission,
    Progress,
    Ready,
    Refusal,
    Report,
    StartClock,
    StepRequest,
    Stop,
    decode_gossip,
    encode,
)
from kantor_protocol.wire.weights import Units
from kantor_worldsim.record.journal import Journal
from kantor_worldsim.record.records import (
    Batch,
    EnvelopeIndex,
    Opening,
    ProcessEvent,
    Record,
    encode_record,
)
from kantor_worldsim.world.world import WorldSetup
from support.missions import ROOMS_MISSION, on_map, setup_of
from support.replication.attesting import Member
from support.strategies import SMALL, mission

GOODS = 48
"""Good inputs of a kind."""


# Missions.


class Played:
    """A small mission with all that went through it."""

    def __init__(self, scenario: Scenario, setup: WorldSetup | None = None) -> None:
        self.scenario = scenario
        self.setup = setup or WorldSetup.of(scenario, 1)
        self.records: list[Record] = []
        play(scenario, 1, self.setup, [self.records.append])
        index = EnvelopeIndex()
        self.inputs: list[Inputs] = []
        self.outputs: list[Outputs] = []
        self.names: list[str] = []
        for record in self.records:
            if isinstance(record, Batch):
                index.add(record)
        for record in self.records:
            for step_record in record.step_records if isinstance(record, Batch) else ():
                if step_record.outputs is not None:
                    self.inputs.append(index.inputs(step_record))
                    self.outputs.append(step_record.outputs)
                    self.names.append(step_record.name)

    @property
    def opening(self) -> Opening:
        """Its first record."""
        opening = self.records[0]
        assert isinstance(opening, Opening)
        return opening

    def bodies(self) -> Iterator[bytes]:
        """Of all envelopes."""
        for outputs in self.outputs:
            yield from (envelope.body for envelope in outputs.outbox)


SHORT = ("limit_s=3.0", "radio.range_m=70")
DENSITY: dict[str, tuple[str, ...]] = {
    "ledger": (),
    "min": ("merge=min", "claims=false"),
    "centralized": ("coordination=centralized",),
    "restarted": ('faults=[{kind="kill", who=["r1"], from_s=0.8, until_s=1.2, disk="lost"}]',),
    "hostile": ('faults=[{kind="hostile", probability=0.5}]',),
    "spectral": ("planner=spectral", "planner.modes=3"),
}
MAP: dict[str, tuple[str, ...]] = {
    "burgard": ("planner=burgard",),
    "market": ("planner=market",),
    "allocated": ("planner=kmeans", "coordination=centralized"),
}


_ALL = (*DENSITY, *MAP)


@functools.cache
def played(name: str) -> Played:
    """One of the missions above."""
    if name in DENSITY:
        return Played(mission(*SHORT, *DENSITY[name]))
    scenario = on_map("limit_s=3.0", *MAP[name])
    return Played(scenario, setup_of(scenario))


def _every(names: Iterable[str] = _ALL) -> Iterator[Played]:
    return map(played, names)


# Grammars.


def messages(contents: Iterable[bytes], most: int = GOODS, longest: int = 1200) -> Mutations:
    """Of msgpack values."""
    goods = (Good(content, msgpack_spans(content)) for content in pick(contents, most, longest))
    return Mutations(Grammar(tuple(goods), MSGPACK_TOKENS))


def texts(contents: Iterable[bytes], tokens: Iterable[bytes]) -> Mutations:
    """Of lines and words."""
    goods = (Good(content, text_spans(content)) for content in contents)
    return Mutations(Grammar(tuple(goods), tuple(tokens)))


def files(
    contents: Iterable[bytes], spans: Callable[[bytes], tuple[Span, ...]] = even_spans
) -> Mutations:
    """Of bytes whose values we do not know."""
    goods = tuple(Good(content, spans(content)) for content in contents)
    return Mutations(Grammar(goods, MSGPACK_TOKENS))


def gossip(*names: str) -> Mutations:
    """Bodies of envelopes, of these missions or of all."""
    return messages(body for each in _every(names or _ALL) for body in each.bodies())


@functools.cache
def attesting(*overrides: str) -> tuple[Member, tuple[bytes, ...]]:
    """r1 of a signed team in a line, and what r2 said meanwhile: it brings r3 the word of r1."""
    scenario = mission("trust=signed", "robots.count=3", *overrides)
    one, two, three = (Member(name, scenario, 12, Units.of(30, 12)) for name in scenario.robot_ids)
    said = []
    for step in range(60):
        if step % 6 == 0:
            one.buy(step // 6, 2)
            two.buy(11 - step // 6, 1)
        if scenario.register_width:
            one.write([1 + step % 3, *[0] * (scenario.register_width - 1)])
        else:
            one.claim(step % 12)
        first, second, third = one.speak(), two.speak(), three.speak()
        one.hear(second)
        two.hear(first, third)
        three.hear(second)
        said.append(second.body)
    return one, tuple(said)


def attested_gossip(*overrides: str) -> Mutations:
    """Bodies of envelopes that bring the word of another."""
    _, said = attesting(*overrides)
    return messages(body for body in said if decode_gossip(body).attestations)


def gossip_fields(name: str) -> Framed:
    """The sender's place, and the fields that it sends: version vector, logs, claims, registers."""
    received = [decode_gossip(body) for body in pick(played(name).bodies(), GOODS, 2000)]
    goods = [
        (bytes((i % 3 + 1,)), n.version_vector, n.logs, n.claims, n.registers)
        for i, n in enumerate(received)
    ]
    # A sender that knows of second incarnations has twice as many numbers.
    longer = [
        (place, version_vector + bytes(len(number_spans(version_vector))), *rest)
        for place, version_vector, *rest in goods[::4]
    ]
    return Framed([*goods, *longer], LEB_TOKENS)


def register_fields() -> Framed:
    """The sender's place, and the registers that it sends."""
    received = [
        decode_gossip(body)
        for name in ("spectral", "market")
        for body in pick(played(name).bodies(), GOODS, 1500)
    ]
    goods = [(bytes((i % 3,)), message.registers) for i, message in enumerate(received)]
    return Framed(goods, LEB_TOKENS)


def packed() -> Framed:
    """Packed pairs."""
    found = {o.spent for o in played("ledger").outputs} | {o.lowered for o in played("min").outputs}
    return Framed([(content,) for content in pick(found, GOODS, 400)], LEB_TOKENS)


def inputs() -> Mutations:
    """What reached participants."""
    return messages(encode(given) for each in _every() for given in each.inputs)


def from_participants() -> Mutations:
    """Reports and Ready."""
    done = [outputs for each in _every() for outputs in each.outputs]
    reports = [encode(Report(VERSION, "ab", each, 7, (("r2", 3),), 2)) for each in done]
    return messages([*pick(reports, GOODS - 2, 1200), encode(Ready(VERSION, "ab", 1, 5, 9))])


def to_participants() -> Mutations:
    """Missions, step requests, and the rest."""
    missions = [
        encode(Mission(VERSION, "ab", each.scenario, 1, Array.of(each.setup.starts_m),
                       Array.of(each.setup.samples_m), "wall", each.opening.frame, "run",
                       Body(Pose(1.0, 2.0), 3, 4, 1)))
        for each in _every()
    ]  # fmt: skip
    requests = [encode(StepRequest(VERSION, given)) for each in _every() for given in each.inputs]
    observation = played("ledger").inputs[0].observation
    other = [StartClock(VERSION, "ab", 5, 2.0, observation, 3), Stop(VERSION, "over")]
    small = [*map(encode, other), encode(Refusal(VERSION, "ab", "no such robot"))]
    return messages([*missions, *pick(requests, GOODS - 12, 1200), *small], longest=3000)


def progress() -> Mutations:
    """How missions go."""
    numbers = (1, "running", "", 3, 9, 1, 4, 2.5, 3, 7.5, 0, 3)
    return messages(
        [encode(Progress(VERSION, *numbers)), encode(Progress(VERSION, *numbers, 0.5, 9.0))]
    )  # type: ignore[arg-type]


def records() -> Mutations:
    """Of every kind."""
    event = ProcessEvent(7, "r1", "start", 2, 3, 1)
    found = [encode_record(record) for each in _every() for record in each.records]
    openings = [encode_record(each.opening) for each in _every()]
    return messages([*pick(found, GOODS - 8, 2500), *openings, encode_record(event)], 64, 4000)


def batches() -> Mutations:
    """Of missions with three robots and one with a supervisor."""
    found = [r for each in _every() for r in each.records if isinstance(r, Batch)]
    return messages(map(encode_record, found), longest=2000)


def weights() -> Mutations:
    """What robots put on their weights keys."""
    found = [o.weights for each in _every(DENSITY) for o in each.outputs if o.weights]
    return messages(found, longest=400)


def arrays() -> Mutations:
    """Of the kinds that travel."""
    made = [np.zeros((2, 2)), np.zeros((0, 2)), np.ones((3, 4), dtype=np.uint8), np.arange(3.0)]
    return messages(encode(Array.of(array)) for array in made)


def scans() -> Framed:
    """Scans, with x, y and heading beside them."""
    given = [i.observation for i in played("burgard").inputs if i.observation.scan]
    goods = [
        (o.scan, np.array([o.pose.x_m, o.pose.y_m, o.pose.heading_rad]).tobytes()) for o in given
    ]
    unusable = (np.nan, np.inf, -np.inf, -0.0, 1e308, 5e-324, 16.0, -1e-300)
    tokens = [np.float64(number).tobytes() for number in unusable]
    return Framed(goods[:GOODS], (*tokens, b"\xff\xff" * 90, b"\x00\x00" * 90, *LEB_TOKENS))


# Texts.

FAULT_TABLES = (
    *('[[faults]]\nkind = "drop"\nprobability = 0.2\nfrom_s = 1\nuntil_s = 2.5\n',),
    *('[[faults]]\nkind = "partition"\nshape = "groups"\ngroups = [["r1"], ["r2"]]\n',),
    *('[[faults]]\nkind = "kill"\nwho = ["r1"]\nfrom_s = 1.0\nuntil_s = 2.0\ndisk = "torn"\n',),
    *('[[faults]]\nkind = "clock"\nwho = ["r2"]\noffset_s = -3\nrate_ppm = 50.0\n',),
    *('[[faults]]\nkind = "slow"\nwho = ["r3"]\nevery = 3\n',),
    *('[[faults]]\nkind = "range"\nrange_m = 12.0\n',),
)
"""Tables of faults."""

TOML_TOKENS = tuple(
    token.encode()
    for token in (
        *("nan", "inf", "-inf", "-1", "0", "1e999", "9" * 400, "0x1f", "true", '""', "[]", "{}"),
        *("1979-05-27T07:32:00Z", "07:32:00", '"""', "'''", "[", "[[", "]]", "=", ".", "#", "\\"),
        *('"r1"', '["r1"]', '["r9"]', '["supervisor"]', '["worldsim"]', "[[0.0, 0.0]]", '"é"'),
        *("\x00", "\u202e", "\ud7ff", '"\\ud800"', "a.b.c", "[" * 50, "[" * 5000, "{a=" * 50),
        *('"dubins"', '"min"', '"spectral"', '"centralized"', '"a.csv"', "4611686018427387904"),
        *("1e-9", "1e9", "3", "2000", "from_s = -1\n", "until_s = 0.5\n", 'who = ["r1"]\n'),
        *("a." * 40 + "a", "a." * 3000 + "a", '"~/a.csv"', '"file:///a%E9.csv"', "\ufeff", "1e308"),
        *("[faults]\n", "[[faults]]\n", "[radio]\n", "drop = 0.5\n", *FAULT_TABLES),
    )
)


def texts_of_scenarios() -> Iterator[str]:
    yield SMALL
    yield SMALL + FAULT_TABLES[0]
    yield SMALL + FAULT_TABLES[2] + FAULT_TABLES[1]
    yield SMALL + FAULT_TABLES[3]
    yield SMALL.replace('"decentralized"', '"centralized"') + '[planner]\nname = "spectral"\n'
    yield ROOMS_MISSION + FAULT_TABLES[3]


def scenarios() -> Mutations:
    """TOML of whole scenarios."""
    return texts((text.encode() for text in texts_of_scenarios()), TOML_TOKENS)


def chaos_files() -> Mutations:
    """TOML of faults alone."""
    return texts(
        (("".join(FAULT_TABLES[i : i + 2])).encode() for i in range(len(FAULT_TABLES))), TOML_TOKENS
    )


def manifests() -> Mutations:
    """JSON of the manifest of a run."""
    text = b'{"format": 1, "exchange": "wall", "inputs": [\n{"key": "map.file", "name": "/m", "blake2b": null}]}\n'
    words = (b"[", b"{", b"[" * 3000, b"null", b"1e999", b'"', b"\xff", b"9" * 5000, b'"\\ud800"')
    return texts((text, text.replace(b"null", b'"ab"')), words)


def overrides() -> Mutations:
    """As `--set` takes them."""
    good = ("radio.range_m=150", "planner=spectral", "starts.poses_m=[[1.0, 2.0], [3.0, 4.0]]")
    more = ('faults=[{kind="drop", probability=1}]', "name=a-b", "robots.count=2", "merge=min")
    words = [w.encode() for w in (*good, *more, "radio.drop=0.5", "map.layout=office")]
    return texts(words, (b".", b"=", b"..", b"==", *TOML_TOKENS))


def keys() -> Mutations:
    """Key expressions."""
    known = (
        b"kantor/v1/kantor/r1/pose",
        b"kantor/v1/f/r2/alive/0f3a",
        b"kantor/v1/f/world/progress",
    )
    return texts(known, (b"/", b"//", b"**", b"*", b"kantor", b"\xff", b"\x00", b"a" * 300))


def identities() -> Mutations:
    """Credentials files."""
    with tempfile.TemporaryDirectory() as folder:
        credentials.issue(Path(folder), "kantor", ("r1", "r2"))
        authority.issue(Path(folder) / "keys", authority.Wanted("kantor", 2), authority.today())
        contents = [path.read_bytes() for path in sorted(Path(folder).rglob("*.toml"))]
    return texts(contents, (*TOML_TOKENS, b"r1.0123456789abcdef", b"2027-01-01T00:00:00+00:00"))


def journals() -> Mutations:
    """MCAP."""
    with tempfile.TemporaryDirectory() as folder:
        contents = []
        for name in ("ledger", "min", "burgard"):
            path = Path(folder) / name
            journal = Journal(path)
            for record in played(name).records[:4]:
                journal.append(record)
            journal.close()
            contents.append(path.read_bytes())
    return files(contents)


def short_journal() -> bytes:
    """A journal of a run that was cut short."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        journal = Journal(path)
        for record in played("ledger").records[:2]:
            journal.append(record)
        journal.close()
        return path.read_bytes()


MANIFEST_OF_A_RUN = (
    b'{"format": 1, "behaviour": 1, "run": "a26750e94c8a2561", "exchange": "wall", "speed": 2.0, '
    b'"exact_every": null, "resumed": 1, "digest": "00", "records": 2, "record": "whole"}'
)


def manifests_of_runs() -> Mutations:
    """manifest.json of a run."""
    return texts((MANIFEST_OF_A_RUN, MANIFEST_OF_A_RUN.replace(b"null", b"5")), JSON_TOKENS)


def results() -> Mutations:
    """result.json of a run."""
    result = (Path(__file__).parents[1] / "baseline" / "in-process" / "result.json").read_bytes()
    return texts((result, result.replace(b" ", b"")), JSON_TOKENS)


JSON_TOKENS = (
    *(b"[" * 9, b"{" * 9, b'{"a":' * 9, b"]", b"}", b'"', b",", b":", b"null", b"NaN", b"Infinity"),
    *(b"-1", b"1e999", b"9" * 400, b"0.5", b"true", b"\\ud800", b"\x00", b"\xff"),
)


def wal_files() -> Mutations:
    """Write-ahead logs on disk."""
    given = played("ledger").inputs
    with tempfile.TemporaryDirectory() as folder:
        contents = []
        for entries in (0, 1, 3):
            path = Path(folder) / str(entries)
            wal = WalFile(path, "run")
            wal.reset(Body(Pose(1.0, 2.0)))
            for inputs in given[:entries]:
                wal.append(encode(inputs))
            wal.close()
            contents.append(path.read_bytes())
    return files(contents)


def wals() -> Framed:
    """The frames of a write-ahead log: its header, an entry, another one, and a torn end."""
    header = encode(("run", Body(Pose(1.0, 2.0))))
    entries = [bytes(8) + encode(inputs) for inputs in played("ledger").inputs[:GOODS]]
    goods = [(header, *pair, b"") for pair in pairwise(entries)]
    return Framed(goods, MSGPACK_TOKENS, msgpack_spans)


def logs_of_runs() -> Mutations:
    """runs.jsonl of a sweep: its header, and runs; whole or torn."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "runs.jsonl"
        with RunsJournal(path) as journal:
            for seed in range(2):
                journal.add(RunKey("ab", "cd", seed, False), Outcome(failed="nothing", wall_s=0.5))
        content = path.read_bytes()
    return texts((content, content[:-9]), TOML_TOKENS)


# Maps and points.


def _grey() -> Image.Image:
    cells = np.full((7, 9), 254, dtype=np.uint8)
    cells[0], cells[3, 2:5], cells[5, 5] = 0, 0, 205
    return Image.fromarray(cells)


def _clear() -> Image.Image:
    image = _grey().convert("RGBA")
    image.putalpha(_grey())
    return image


def pictures(*kinds: str) -> Mutations:
    """Small images in these formats."""
    contents = []
    for kind in kinds:
        for image in (_grey(), _clear() if kind == "PNG" else _grey().convert("1")):
            file = BytesIO()
            image.save(file, kind)
            contents.append(file.getvalue())
    return files(contents)


MOVING_AI = b"type octile\nheight 3\nwidth 5\nmap\n@@@@@\n@.GT@\n@@@S@\n"
NAV2 = (
    b"image: map.pgm\nresolution: 0.05\norigin: [0.0, -1.5, 0.0]\nnegate: 0\n"
    b"occupied_thresh: 0.65\nfree_thresh: 0.196\nmode: trinary\n"
)


def moving_ai() -> Mutations:
    """MovingAI's maps."""
    return texts(
        (MOVING_AI,), (b"0", b"-1", b"99999999", b"999999999", b"\xff", b"map\n", b".", b"\n")
    )


def nav2() -> Mutations:
    """YAML of Nav2's map_server, beside an image."""
    words = (b"&a", b"*a", b"{", b"[", b"!!python/object:os.system", b"- ", b".nan", b"1e400", b"~",
             b"raw", b"scale", b"../map.pgm", b"/dev/null", b"<<: ", b"0x1", b"1:30", b"\t", b"---\n",
             b"<<: *a\n", b"&a {x: 1}\n", b"!!int 1:30", b"59:" * 3000 + b"1", b"- " * 3000, b"[*a, *a]",
             b"resolution: 0.1\n", b"image: [*a]\n", b"0x" + b"f" * 3000, b"\xff\xfe", b"{" * 3000,
             b"[" * 50, b"? ", b"| ", b"'", b'"', b"2001-01-01", b"%YAML 9\n")  # fmt: skip
    return texts((NAV2, NAV2.replace(b"trinary", b"scale")), words)


def tables_of_points() -> Mutations:
    """CSV."""
    more = b'y,name,x\n1,"a, # b",2\n3,,4\n'
    good = (
        more,
        b"1.0,2.0\n3.5,-4\n",
        b"x,y\n1,2\n3,4\n5,6\n",
        b"# note\n1e3,2e-3\n\n7,8 # here\n",
    )
    return texts(
        good,
        (
            b",",
            b",,",
            b";",
            b"1e308",
            b"x,y\n",
            b"y",
            b'""',
            b"\r",
            b"12.5O",
            b"nan",
            b"inf",
            b"1e999",
            b"#",
            b"\n",
            b'"',
            b"0x1",
            b"1_0",
            b"\xff",
        ),
    )


def arrays_in_files() -> Mutations:
    """NPY."""
    contents = []
    for array in (
        np.ones((3, 2)),
        np.arange(8, dtype="<i4").reshape(4, 2),
        np.zeros((1, 2), "<f4"),
    ):
        file = BytesIO()
        np.save(file, array)
        contents.append(file.getvalue())
    return files(contents, text_spans)
