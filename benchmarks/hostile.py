"""Cost of a hostile robot for the honest ones, attack by attack, and whom world-sim names for it.

    python benchmarks/hostile.py [--quick] [--beside] [--only ATTACK]

A mission with five robots on the real bus for each attack, four of them honest; `hostile_mission.py` says how it is
measured. Exits with 1 if under an attack honest robots make less than 0.9 of their steps, memory grows, a rule is
broken, or anybody but the culprit is named.
"""

import argparse
import itertools
import re
import socket
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import zenoh
from hostile_mission import (
    FLEET,
    HONEST,
    HOSTILE,
    SETTLE_S,
    Attack,
    Hostile,
    Measured,
    Tokens,
    mission_with,
    within,
)
from tables import Table, show, verdict

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import Envelope, Outputs
from kantor_protocol.base.varint import Pairs, put_uint
from kantor_protocol.transport import zenoh_config
from kantor_protocol.transport.endpoint import parse_endpoint
from kantor_protocol.transport.session import open_session
from kantor_protocol.transport.zenoh_config import ACCEPT_PENDING
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import (
    VERSION,
    GossipMessage,
    Ready,
    Report,
    encode,
    encode_gossip,
)
from kantor_protocol.wire.weights import SAMPLES_MAX, Units, WeightsMessage
from kantor_worldsim.exchange.lockstep import BARRIER_S

RATIO_MIN = 0.9
GROWTH_MAX_MIB = 64.0
"""A quarter of what world-sim needs anyway."""
JOIN_MAX_S = 5.0
"""Longest time to join."""
FAST_PER_S = 10_000
JOINS_PER_S = 2000
"""Each is a name that Zenoh keeps until its session ends."""
REPORTS_PER_S = 150
"""Within the quota of messages."""
NAME = re.compile(rf"\b(?:{'|'.join((*HONEST, HOSTILE))})\b")
ROBOTS = len(HONEST) + 1


@dataclass(frozen=True)
class Saying(Attack):
    """One message again and again."""

    compose: Callable[[Hostile], bytes]

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Put it on `tx`."""
        return partial(hostile.send, self.compose(hostile))


def next_step(hostile: Hostile, **fields: Any) -> bytes:
    """The report of a next step, which stays where it is, with other fields of its outputs."""
    assert hostile.observation is not None
    outputs = Outputs(hostile.step + 1, hostile.observation.pose, **fields)
    return encode(
        Report(VERSION, hostile.line.nonce, outputs, hostile.now_ns, (), hostile.step)
    )  # fmt: skip


def ready(hostile: Hostile) -> bytes:
    """Readiness, which asks for a clock."""
    return encode(Ready(VERSION, hostile.line.nonce))


def junk(hostile: Hostile) -> bytes:
    """Zeros, as many as readiness has bytes."""
    return bytes(len(ready(hostile)))


# Outboxes.


def crowded(hostile: Hostile, *, rising: bool) -> bytes:
    """A step with very many small envelopes."""
    numbers = range(100_000) if rising else range(100_000, 0, -1)
    outbox = tuple(Envelope(HOSTILE, number, "", b"") for number in numbers)
    return next_step(hostile, outbox=outbox)


def gossip(**fields: Any) -> bytes:
    """The body of an envelope that has nothing to tell, with other fields."""
    empty = {"step": 1, "version_vector": bytes(2 * ROBOTS), "logs": b"", "claims": b""}
    return encode_gossip(GossipMessage(VERSION, x_m=0.0, y_m=0.0, **(empty | fields)))


def enveloped(hostile: Hostile, body: bytes, source: str = HOSTILE, number: int = 1) -> bytes:
    """A step with one envelope."""
    return next_step(hostile, outbox=(Envelope(source, number, "", body),))


def doubled(hostile: Hostile) -> bytes:
    """A step with one envelope three times under the same number."""
    return next_step(hostile, outbox=3 * (Envelope(HOSTILE, 1, "", gossip()),))


# Forged and endless logs.


def uint(value: int) -> bytes:
    """LEB128."""
    out = np.zeros(10, dtype=np.uint8)
    return out[: put_uint(out, 0, value)].tobytes()


def of_log(origin: int, index: "np.ndarray", units: int) -> bytes:
    """A body that tells the log of an incarnation id from its beginning: so many units of each sample."""
    count = index.shape[0]
    ids = ROBOTS * (origin // ROBOTS + 1)
    held = bytes(origin) + uint(count) + bytes(ids - origin - 1)
    entries = Pairs(count).encode(index, np.full(count, units), count)
    suffix = uint(origin) + uint(0) + 2 * uint(count) + entries
    return gossip(version_vector=held + bytes(ids), logs=suffix)


def consumed(hostile: Hostile, origin: int) -> bytes:
    """A log by which its origin has consumed all weight."""
    samples = hostile.mission.samples.shape[0]
    units = Units.of(hostile.mission.scenario.energy.points, samples)
    each = -(-units.sample // units.point)
    return enveloped(hostile, of_log(origin, np.repeat(np.arange(samples), each), units.point))


def endless(hostile: Hostile) -> bytes:
    """A log of an incarnation that never was, as long as a body has room for, which weighs nothing."""
    origin = (INCARNATIONS_MAX + 1) * ROBOTS - 1
    return enveloped(hostile, of_log(origin, np.zeros(130_000, dtype=np.int64), 0))


def bomb(hostile: Hostile) -> bytes:
    """A step with a weights message of 190 KiB that inflates to 200 MB."""
    packer = zlib.compressobj(9)
    chunks = [packer.compress(bytes(1 << 20)) for _ in range(190)]
    content = b"".join(chunks) + packer.flush()
    return next_step(
        hostile, weights=msgspec.msgpack.encode(WeightsMessage(1, 1, 0, SAMPLES_MAX, content))
    )


@dataclass(frozen=True)
class Forging(Attack):
    """A step in whose outbox is a forged envelope, and a sound one after it."""

    kills: ClassVar[bool] = True

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Report both in turn."""

        def report() -> None:
            hostile.send(enveloped(hostile, gossip(), source=HONEST[0], number=hostile.step + 1))
            number = hostile.step + 1
            hostile.send(enveloped(hostile, gossip(step=number), number=number))

        return report


# Processes under the own id, and time.


@dataclass(frozen=True)
class Impostors(Attack):
    """Other processes under the own id, which are refused."""

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Join and leave in turn."""
        return Tokens(hostile)


@dataclass(frozen=True)
class Successors(Attack):
    """A process that leaves, and is back as another one that is ready at once."""

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Leave and come."""
        line, liveliness = hostile.line, hostile.session.liveliness()
        held = [line._declared.pop()]  # the token of the process that has joined
        numbers = itertools.count()

        def succeed() -> None:
            held.pop().undeclare()
            line.nonce = f"next{next(numbers)}"
            held.append(liveliness.declare_token(keys.alive(FLEET, HOSTILE, line.nonce)))
            hostile.send(ready(hostile))

        return succeed


@dataclass(frozen=True)
class Silence(Attack):
    """A robot that is ready and does not answer."""

    relapses: int
    exchange: ClassVar[str] = "lockstep"

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Fall silent until the others go on without it, so often."""
        for relapse in range(self.relapses):
            hostile.mute = True
            time.sleep(BARRIER_S / 2**relapse + SETTLE_S)
            hostile.mute, step = False, hostile.step
            hostile.await_request(lambda h, step=step: h.step > step + 1)
        return partial(setattr, hostile, "mute", True)

    def rest(self, hostile: Hostile) -> None:
        """Answer again."""
        hostile.mute = False


@dataclass(frozen=True)
class Idle(Attack):
    """Connections that do not prove who they are."""

    count: int
    window_s: ClassVar[float] = 6.0
    joins: ClassVar[bool] = True
    culprits: ClassVar[frozenset[str]] = frozenset()

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Hold so many: open one, or replace the oldest if it was closed."""
        _, host, port = parse_endpoint(hostile.connect)
        held = hostile.held

        def open_or_replace() -> None:
            if len(held) < self.count:
                held.append(socket.create_connection((host, port), timeout=1.0))
            elif _is_closed(held[0]):
                held.pop(0).close()

        return open_or_replace

    def rest(self, hostile: Hostile) -> None:
        """Close them."""
        while hostile.held:
            hostile.held.pop().close()


def _is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(1, socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@dataclass(frozen=True)
class Sessions(Idle):
    """Sessions with the own certificate."""

    protocol: ClassVar[str] = "tls"
    culprits: ClassVar[frozenset[str]] = frozenset({HOSTILE})

    def begin(self, hostile: Hostile) -> Callable[[], object]:
        """Open sessions until there are so many, or no more are let in."""
        held = hostile.held
        config = zenoh_config.client_config(hostile.identity) | {"connect/timeout_ms": 300}

        def open_one() -> None:
            if len(held) < self.count:
                try:
                    held.append(open_session("client", config, connect=hostile.connect))
                except zenoh.ZError:
                    time.sleep(0.1)

        return open_one


ATTACKS: tuple[Attack, ...] = (
    Saying("ready", FAST_PER_S, ready),
    Saying("junk", FAST_PER_S, junk),
    Impostors("impostors", JOINS_PER_S),
    Successors("successors", JOINS_PER_S),
    Saying("outbox, rising", 10, partial(crowded, rising=True)),
    Saying("outbox, falling", 10, partial(crowded, rising=False)),
    Saying("weights bomb", 20, bomb),
    Saying("log of another", REPORTS_PER_S, partial(consumed, origin=0)),
    Saying("own log", REPORTS_PER_S, partial(consumed, origin=ROBOTS - 1)),
    Saying("log of the last incarnation", REPORTS_PER_S, partial(consumed, origin=INCARNATIONS_MAX * ROBOTS)),
    Saying("endless log", REPORTS_PER_S, endless),
    Forging("forged, then sound", REPORTS_PER_S / 2),
    Saying("number of a forgery", REPORTS_PER_S, partial(enveloped, body=gossip(), number=(1 << 62) + 5)),
    Saying("malformed body", REPORTS_PER_S, partial(enveloped, body=b"\xc1")),
    Saying("one number thrice", REPORTS_PER_S, doubled),
    Silence("silent in lockstep", 1, 6),
    Idle("101 idle connections", 1000, 101),
    Idle("520 idle connections", 1000, ACCEPT_PENDING + 20),
    Sessions("100 sessions", 100, 100),
)  # fmt: skip


class Judged(NamedTuple):
    """An attack, measured and judged."""

    row: tuple[str, ...]
    misses: tuple[str, ...]
    """The targets that are missed."""


def judge(attack: Attack, measured: Measured) -> Judged:
    """Compare with the targets."""
    calm, rough = (
        float(np.median([measured.steps_per_s(w) for w in windows]))
        for windows in (measured.calm, measured.rough)
    )
    ratio = rough / calm if calm else 0.0
    growths = {who: measured.growth_mib(who) for who in measured.uses}
    robots_mib = max(mib for who, mib in growths.items() if who != "worldsim")
    joins_s = [within(measured.joins, windows) for windows in (measured.calm, measured.rough)]
    named = names_in(measured)
    targets = {
        "steps": ratio >= RATIO_MIN,
        "memory": max(growths.values()) < GROWTH_MAX_MIB,
        "named": named == attack.culprits,
        "rules": measured.result["violations"] == 0,
        "joins": not attack.joins or (bool(joins_s[1]) and np.median(joins_s[1]) < JOIN_MAX_S),
    }
    misses = tuple(target for target, met in targets.items() if not met)
    return Judged(
        (
            attack.name,
            f"{measured.sent_per_s:,.0f}",
            f"{calm:.1f}",
            f"{rough:.1f}",
            f"{ratio:.2f}",
            f"{1e3 * measured.longest_gap_s(measured.calm):.0f}",
            f"{1e3 * measured.longest_gap_s([measured.prelude, *measured.rough]):.0f}",
            f"{100 * measured.cores(measured.calm):.0f}",
            f"{100 * measured.cores(measured.rough):.0f}",
            f"{growths['worldsim']:.0f}",
            f"{robots_mib:.0f}",
            *(f"{1e3 * max(s):.0f}" if s else "" for s in joins_s),
            " ".join(sorted(named)) or "nobody",
            verdict(met=not misses),
        ),
        misses,
    )


def names_in(measured: Measured) -> frozenset[str]:
    """The robots that world-sim names, in its lines and in result.json."""
    result = measured.result
    texts = [line for line in measured.lines if NAME.match(line)] + result["complaints"]
    blamed = {*result["excess"], *result["refused_reports"], *result["silences"]}
    return frozenset(blamed.union(*(NAME.findall(text) for text in texts)))


HEAD = (
    "attack", "sent/s", "steps/s", "attacked", "ratio", "gap ms", "attacked", "cpu %", "attacked",
    "MiB", "robots", "join ms", "attacked", "named", "",
)  # fmt: skip
NOTES = (
    "steps/s: of each honest robot, the median over windows; ratio: of these medians",
    "gap: the longest time without a new step of an honest robot",
    "cpu: of world-sim; MiB: what its memory grew by after the first window, and that of an honest robot",
    "join: the longest time until a process that joined had its clock started",
    "named: in world-sim's output and in result.json",
)


def measure(attacks: Sequence[Attack], *, quick: bool, beside: bool) -> Table:
    """One mission for each attack."""
    rounds = 2 if quick else 5
    rows, notes = [], []
    for attack in attacks:
        judged = judge(attack, mission_with(attack, rounds, beside=beside))
        show(Table(attack.name, HEAD, [judged.row]))
        rows.append(judged.row)
        if judged.misses:
            notes.append(f"{attack.name} misses: {', '.join(judged.misses)}")
    where = "beside them" if beside else "on its own core"
    title = f"hostile: {len(HONEST)} honest robots, the hostile one {where}"
    return Table(title, HEAD, rows, (*NOTES, *notes), not notes)


def main() -> int:
    """Measure and print; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description="What a hostile robot costs the others.")
    parser.add_argument("--quick", action="store_true", help="shorter")
    parser.add_argument(
        "--beside", action="store_true", help="the hostile robot competes for all cores"
    )
    parser.add_argument("--only", metavar="ATTACK", help="attacks with this in their names")
    options = parser.parse_args()
    attacks = [attack for attack in ATTACKS if (options.only or "") in attack.name]
    if not attacks:
        parser.error(f"--only: choose from {', '.join(attack.name for attack in ATTACKS)}")
    table = measure(attacks, quick=options.quick, beside=options.beside)
    show(table)
    return 0 if table.met else 1


if __name__ == "__main__":
    sys.exit(main())
