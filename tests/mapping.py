"""Missions on a map for tests of referees: simple robots in a simple world, played to records.

The robots walk from cell to cell, each to the frontier that is nearest to it, and share their logs. What
they do is sound; whoever needs something unsound changes the records.
"""

import math
from collections import deque
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from kantor_agent.chart import Chart
from kantor_protocol.evidence import CODES, NO_RETURN, Evidence, beam_rad, entries, void
from kantor_protocol.grid import FREE, OCCUPIED, UNKNOWN, Frame, next_cell
from kantor_protocol.kernels import kernel
from kantor_protocol.machine import EVERYBODY, Envelope, Observation, Outputs, Pose, State
from kantor_protocol.messages import VERSION, News, decode_news, encode_news
from kantor_protocol.replica import Replica
from kantor_protocol.scenario import Scenario, Sensor, parse
from kantor_worldsim.channel import Verdict
from kantor_worldsim.maps import Ground
from kantor_worldsim.records import Act, Batch, Ending, Record, opening_of
from kantor_worldsim.world import Ruling, Site

PERIOD_NS = 100_000_000

MAPPING = """
name = "rooms"

[map]
layout = "blank"

[robots]
count = 2

[starts]
poses_m = [[1.5, 1.5], [9.5, 1.5]]

[vehicle]
speed_m_s = 20.0

[planner]
name = "frontier"

[sensor]
range_m = 4.0
beams = 90

[radio]
range_m = 8.0
"""

ROOMS = """
################
#......#.......#
#......#.......#
#..............#
#......#.......#
####.#####.#####
#......#.......#
#......#.......#
#..............#
#......#....#..#
#......#.......#
################
"""
"""16 x 12 cells of one metre."""


def ground_of(picture: str, resolution_m: float = 1.0) -> Ground:
    """A map from lines of text, the highest row first: # is occupied, a blank unknown, . free."""
    lines = picture.strip("\n").splitlines()[::-1]
    kinds = {"#": OCCUPIED, ".": FREE, " ": UNKNOWN}
    cells = np.array([[kinds[letter] for letter in line] for line in lines], dtype=np.uint8)
    return Ground(Frame(resolution_m, (0.0, 0.0), *cells.shape), cells)


def on_map(*overrides: str) -> Scenario:
    """The small mission on a map with `key.sub=value` overrides."""
    return parse(MAPPING, "rooms", overrides)


@kernel
def _cast(
    cells: np.ndarray,
    u: float,
    v: float,
    heading_rad: float,
    view_rad: float,
    range_cells: float,
    codes: np.ndarray,
) -> None:
    for beam in range(codes.shape[0]):
        angle_rad = beam_rad(heading_rad, view_rad, codes.shape[0], beam)
        du, dv = math.cos(angle_rad), math.sin(angle_rad)
        column, row = int(math.floor(u)), int(math.floor(v))
        codes[beam] = NO_RETURN
        while True:
            row, column, share = next_cell(row, column, u, v, du, dv)
            inside = 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]
            if share > range_cells or not inside:
                break
            if cells[row, column] != FREE:
                codes[beam] = int(round(share / range_cells * CODES))
                break


def scan(ground: Ground, pose: Pose, sensor: Sensor) -> bytes:
    """What an exact range finder measures."""
    codes = np.zeros(sensor.beams, dtype=np.uint16)
    frame = ground.frame
    u = (pose.x_m - frame.origin_m[0]) / frame.resolution_m
    v = (pose.y_m - frame.origin_m[1]) / frame.resolution_m
    view_rad = math.radians(sensor.field_of_view_deg)
    range_cells = sensor.range_m / frame.resolution_m
    _cast(ground.cells, u, v, pose.heading_rad, view_rad, range_cells, codes)
    return codes.astype("<u2").tobytes()


class Rover:
    """A robot that walks to the nearest frontier."""

    def __init__(self, place: int, scenario: Scenario, frame: Frame, start_m: npt.NDArray) -> None:
        self.name = scenario.robot_ids[place]
        self.pose = Pose(*start_m.tolist())
        self.state = State.EXPLORING
        self.step = 0
        robots = scenario.robots.count
        self._place, self._frame, self._scenario = place, frame, scenario
        self._replica = Replica(place, robots, entries(frame), None, ledger=True, claims=False)
        ranges = scenario.planner.name == "burgard"
        self._evidence = Evidence(frame, scenario.sensor, ranges=ranges)
        self._chart = Chart(frame, robots)
        self._looked: Pose | None = None
        self._voids: set[int] = set()

    def act(self, observation: Observation, inbox: Iterable[Envelope]) -> Outputs:
        """One step."""
        for envelope in inbox:
            source = self._scenario.robot_ids.index(envelope.source)
            news = decode_news(envelope.body)
            assert self._replica.learn(source, news.have, news.logs, news.claims)
        news = self._evidence.take(
            observation.scan, observation.pose, moved=observation.pose != self._looked
        )
        self._looked = observation.pose
        self._replica.append(news)
        self._chart.fold(self._replica)
        self.step += 1
        goal = None
        if self.state is State.EXPLORING:
            goal = self._walk(idle=not news.shape[0])
        have, logs, claims = self._replica.compose()
        self._replica.end_step()
        told = News(VERSION, self.step, self.pose.x_m, self.pose.y_m, have, logs, claims)
        body = encode_news(told)
        envelope = Envelope(self.name, self.step, EVERYBODY, body)
        return Outputs(self.step, self.pose, goal=goal, outbox=(envelope,), state=self.state)

    def _walk(self, *, idle: bool) -> tuple[float, float] | None:
        frame, cells = self._frame, self._chart.cells
        here = frame.cell_of(self.pose.x_m, self.pose.y_m)
        frontiers = set(self._chart.frontiers.tolist())
        if here in frontiers and idle and here not in self._voids:
            self._voids.add(here)
            self._replica.append(np.array([void(frame, here)]))
            frontiers.discard(here)
        came, queue = {here: here}, deque([here])
        while queue:
            cell = queue.popleft()
            if cell in frontiers and cell != here:
                goal = cell
                while came[cell] != here:
                    cell = came[cell]
                self.pose = Pose(*frame.centre_of(cell))
                return frame.centre_of(goal)
            for beside in (cell - 1, cell + 1, cell - frame.columns, cell + frame.columns):
                if 0 <= beside < frame.cells and cells[beside] == FREE and beside not in came:
                    came[beside] = cell
                    queue.append(beside)
        if here not in frontiers:
            self.state = State.FINISHED
        return None


def explore(
    scenario: Scenario, ground: Ground, *, ticks: int = 1000, seed: int = 1
) -> list[Record]:
    """The records of a mission, until every robot has finished."""
    starts_m = np.array(scenario.starts.poses_m)
    site = Site(np.zeros((0, 2)), np.zeros((0, 2)), starts_m, ground)
    rovers = [Rover(i, scenario, ground.frame, start) for i, start in enumerate(starts_m)]
    records: list[Record] = [opening_of(scenario, seed, site, {r.name: () for r in rovers})]
    inboxes: dict[str, list[Envelope]] = {rover.name: [] for rover in rovers}
    now_ns, reason = 0, "limit"
    for tick in range(1, ticks + 1):
        now_ns = tick * PERIOD_NS
        places = {rover.name: rover.pose for rover in rovers}
        acts: list[Act] = []
        sent: list[Envelope] = []
        for rover in rovers:
            inbox, inboxes[rover.name] = inboxes[rover.name], []
            look = Observation(tick - 1, rover.pose, scan=scan(ground, rover.pose, scenario.sensor))
            outputs = rover.act(look, inbox)
            heard = tuple((envelope.source, envelope.sequence) for envelope in inbox)
            acts.append(Act(rover.name, now_ns, look, heard, outputs, Ruling(outputs.pose)))
            sent += outputs.outbox
        verdicts = []
        for envelope in sent:
            for rover in rovers:
                if rover.name == envelope.source:
                    continue
                a, b = places[envelope.source], places[rover.name]
                if math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) <= scenario.radio.range_m:
                    verdicts.append(Verdict(envelope.source, envelope.sequence, rover.name, now_ns))
                    inboxes[rover.name].append(envelope)
        records.append(Batch(now_ns, tuple(acts), tuple(verdicts), 0))
        if all(rover.state is State.FINISHED for rover in rovers):
            reason = "done"
            break
    records.append(Ending(now_ns, reason))
    return records
