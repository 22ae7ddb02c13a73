"""Transcripts of robots: commands, line by line, and the outputs that follow.

A line that begins with `>` is a command, the lines below it are what follows from it. After a wanted
change of behaviour run `pytest tests/agent/robots/test_transcripts.py --rewrite` and read the difference: commit
it only if you understand what caused it.

    > fleet N KEY=VALUE …     N robots that start at the origin, with overrides of the scenario
    > samples X,Y X,Y …       where the samples are
    > step NAME [SECONDS]     the robot steps, a period (or that long) after its step before
    > deliver FROM TO [k]     its k-th envelope (by default the last) goes into the other's inbox
    > garble FROM TO          the last envelope arrives cut in half
    > shove NAME X,Y          world-sim reports that the robot is elsewhere
"""

from pathlib import Path

import numpy as np
import pytest

from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.machine import Body, Envelope, Inputs, Observation, Outputs, Pose
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.cosine_basis import VISIT
from kantor_protocol.replication.registers import read_register
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import GossipMessage, decode_gossip
from kantor_protocol.wire.version_vector import read_version_vector
from support.replication.replicas import read_logs

FOLDER = Path(__file__).parent / "transcripts"
BASE = """
name = "transcript"
domain = { min_m = [-1000, -1000], max_m = [1000, 1000] }
robots = { count = 1 }
starts = { poses_m = [[0, 0]] }
energy = { points = 8 }
samples = { count = 1 }
density = [{ mean_m = [0, 0], variance_m2 = [1, 1] }]
"""


class Team:
    """Robots that follow the commands of a transcript."""

    def __init__(self) -> None:
        self.scenario: Scenario
        self.points = np.zeros((0, 2))
        self.robots: dict[str, DensityRobot] = {}
        self.now_ns: dict[str, int] = {}
        self.observed: dict[str, Observation] = {}
        self.inbox: dict[str, list[Envelope]] = {}
        self.sent: dict[str, list[Envelope]] = {}

    def run(self, line: str) -> list[str]:
        """The lines that follow from a command."""
        verb, *words = line.split()
        lines = getattr(self, verb)(*words)
        return [] if lines is None else list(lines)

    def fleet(self, count: str, *overrides: str) -> None:
        """> fleet"""
        places = ", ".join(["[0, 0]"] * int(count))
        self.scenario = parse(
            BASE, "transcript", [f"robots.count={count}", f"starts.poses_m=[{places}]", *overrides]
        )

    def samples(self, *points: str) -> None:
        """> samples"""
        self.points = np.array([[float(v) for v in point.split(",")] for point in points])
        for name in self.scenario.robot_ids:
            self.robots[name] = DensityRobot(
                name, self.scenario, 0, Body(Pose(0.0, 0.0)), self.points
            )
            self.now_ns[name], self.inbox[name], self.sent[name] = 0, [], []
            self.observed[name] = Observation(0, Pose(0.0, 0.0))

    def step(self, name: str, seconds: str = "") -> list[str]:
        """> step"""
        elapsed_ns = round(float(seconds) * 1e9) if seconds else self.scenario.period_ns
        self.now_ns[name] += elapsed_ns
        inbox, self.inbox[name] = tuple(self.inbox[name]), []
        outputs = self.robots[name].step(Inputs(self.now_ns[name], self.observed[name], inbox))
        self.observed[name] = Observation(outputs.step, outputs.pose)
        self.sent[name] += outputs.outbox
        return self._lines(outputs)

    def deliver(self, source: str, target: str, which: str = "") -> None:
        """> deliver"""
        envelope = self.sent[source][int(which) - 1 if which else -1]
        self.inbox[target].append(envelope)

    def garble(self, source: str, target: str) -> None:
        """> garble"""
        last = self.sent[source][-1]
        half = last.body[: len(last.body) // 2]
        self.inbox[target].append(Envelope(last.source, last.sequence, last.target, half))

    def shove(self, name: str, place: str) -> None:
        """> shove"""
        x, y = (float(v) for v in place.split(","))
        self.observed[name] = Observation(self.observed[name].step, Pose(x, y))

    def _lines(self, outputs: Outputs) -> list[str]:
        pose, goal = outputs.pose, outputs.goal
        lines = [
            f"step {outputs.step} at ({pose.x_m:.4g}, {pose.y_m:.4g}), "
            f"goal {'none' if goal is None else f'({goal[0]:g}, {goal[1]:g})'}, "
            f"energy {outputs.energy_spent}, {outputs.state.name.lower()}"
            + (f", refused {outputs.refused}" if outputs.refused else "")
        ]
        for label, packed in (("spent", outputs.spent), ("left", outputs.lowered)):
            if packed:
                lines.append(f"{label} {self._pairs(packed)}")
        lines += [self._message(envelope) for envelope in outputs.outbox]
        return lines

    def _pairs(self, packed: bytes) -> str:
        pairs = Pairs().decode(packed, len(self.points))
        assert pairs is not None
        return " ".join(f"{j}:{u}" for j, u in zip(*map(np.ndarray.tolist, pairs), strict=True))

    def _message(self, envelope: Envelope) -> str:
        news = decode_gossip(envelope.body)
        logs = read_logs(news.logs)
        version_vector = read_version_vector(news.version_vector, len(self.scenario.roster))
        assert logs is not None
        entries = " ".join(f"r{o + 1}#{at}={j}:{u}" for o, at, j, u in logs.tolist())
        claims = "claims " if news.claims else ""
        to = envelope.target or "everybody"
        return f"to {to}: {claims}has {version_vector}, tells {entries or 'nothing'}{self._registers(news)}"

    def _registers(self, news: GossipMessage) -> str:
        """Visits by origin, for those that the message has: the first number counts them."""
        width, listed = self.scenario.register_width, []
        for place, name in enumerate(self.scenario.roster if width else ()):
            found = read_register(news.registers, len(self.scenario.roster), width, place)
            assert found is not None
            stamp, numbers = found
            listed += [f" {name}#{stamp}={numbers[0] // VISIT}"] if stamp else []
        return f", registers{''.join(listed) or ' none'}" if width else ""


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.txt")), ids=lambda path: path.stem)
def test_transcript(path: Path, request: pytest.FixtureRequest) -> None:
    """Robots do what the transcript says, to the letter."""
    team, lines = Team(), []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("> "):
            lines += [line, *(f"  {line_out}" for line_out in team.run(line[2:]))]
        elif not line.startswith("  "):
            lines.append(line)
    text = "\n".join(lines) + "\n"
    if request.config.getoption("--rewrite"):
        path.write_text(text, encoding="utf-8")

    assert path.read_text(encoding="utf-8") == text
