"""Several machines: a hub, a site with a router of its own, and robots at both, on the real bus with
certificates.
"""

import os
import queue
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest
import zenoh

from kantor_protocol.transport import zenoh_config
from kantor_protocol.transport.credentials import Certificate, read
from kantor_protocol.transport.endpoint import free_endpoint
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import (
    acts_of,
    await_act,
    await_incident,
    await_line,
    incidents_of,
    records_of,
    result_of,
)
from support.processes.intruders import plain_session

if TYPE_CHECKING:
    from support.processes.command import Kantor, Process

ROOT = "kantor/v1/kantor"
FORGED = b"forged"
BLOCK = zenoh.CongestionControl.BLOCK
MISSION = (
    "fleet", "--seed", 3, "--set", "robots.count=3", "starts.random=true", "starts.poses_m=[]",
    "energy.points=600", "energy.steps=600", "radio.range_m=900",
)  # fmt: skip


class Place:
    """A hub and a site on this machine, with the keys of a fleet of three, two of them at the site."""

    def __init__(self, kantor: "Kantor") -> None:
        self.kantor = kantor
        self.hub, self.north = free_endpoint("tls"), free_endpoint("tls")
        made = kantor("keys", "kantor", "--robots", 3, "--site", "north=r1,r2")
        assert made.code == 0, made.err

    def start(self, *arguments: object, at: str, user: str) -> "Process":
        """A process with the identity of a user."""
        return self.kantor.start(*arguments, "--connect", at, "--credentials", f"keys/{user}.toml")

    def world_sim(self, *arguments: object) -> "Process":
        """World-sim, up and waiting."""
        world = self.kantor.start(
            "worldsim", *arguments, "--listen", self.hub, "--credentials", "keys"
        )
        await_line(world, "t=")
        return world

    def site(self) -> "Process":
        """The site, connected."""
        site = self.start("site", "north", "--listen", self.north, at=self.hub, user="site-north")
        await_line(site, self.hub, "connected")
        return site

    def robots(self) -> dict[str, "Process"]:
        """r1 and r2 at the site, r3 at the hub."""
        places = {"r1": self.north, "r2": self.north, "r3": self.hub}
        return {
            name: self.start("agent", name, at=place, user=name) for name, place in places.items()
        }

    @contextmanager
    def intruder(
        self, user: str, mode: str, connect: str, listen: str | None = None
    ) -> Iterator[zenoh.Session]:
        """Plain Zenoh with the identity file of a user and without any rules of its own."""
        identity = read(self.kantor.folder / "keys" / f"{user}.toml", Certificate)
        assert identity is not None
        with plain_session(connect, zenoh_config.client_config(identity), mode, listen) as session:
            yield session


@pytest.fixture
def place(kantor: "Kantor") -> Place:
    """A hub and a site."""
    return Place(kantor)


def hear(session: zenoh.Session, *keys: str) -> "queue.SimpleQueue[str]":
    """The keys of all that arrives, but for what was forged here."""
    heard: queue.SimpleQueue[str] = queue.SimpleQueue()

    def take(sample: zenoh.Sample) -> None:
        if sample.payload.to_bytes() != FORGED:
            heard.put(str(sample.key_expr))

    for key in keys:
        session.declare_subscriber(key, take)
    return heard


def drained(heard: "queue.SimpleQueue[str]") -> list[str]:
    """What has arrived so far."""
    return [heard.get() for _ in range(heard.qsize())]


def test_a_mission_through_a_site_is_the_one_in_process(place: Place) -> None:
    """Two robots behind a site's router and one at the hub, in lockstep: the digest of one process, signed as well.

    Beside it, with the files of r1 and r3, an intruder at the site sends as others and reads others' `rx`.
    """
    kantor = place.kantor
    assert kantor("run", *MISSION, "trust=signed", "--exchange", "in-process").code == 0
    world = place.world_sim(*MISSION, "--exchange", "lockstep")
    site = place.site()
    others = (f"{ROOT}/**", f"{ROOT}/r2/rx", f"{ROOT}/r3/rx", f"{ROOT}/*/tx", f"{ROOT}/*/pose")
    with (
        place.intruder("r1", "client", place.north) as liar,
        place.intruder("r1", "client", place.north) as ear,  # apart: a session hears its own puts
        place.intruder("r3", "client", place.north) as guest,  # of the hub, unknown at this site
    ):
        stolen, overheard = hear(ear, *others), hear(guest, f"{ROOT}/r3/rx")
        tokens = [
            liar.liveliness().declare_token(f"{ROOT}/{name}/alive/forged") for name in ("r2", "r3")
        ]
        robots = place.robots()
        for name in ("r2", "r3"):
            for kind in ("tx", "rx", "pose", "weights"):
                liar.put(f"{ROOT}/{name}/{kind}", FORGED, congestion_control=BLOCK)
        guest.put(f"{ROOT}/r3/tx", FORGED, congestion_control=BLOCK)
        out, err = world.communicate(timeout=EVENT_LIMIT_S)
        assert drained(stolen) + drained(overheard) == []
        for token in tokens:
            token.undeclare()

    assert world.returncode == 0, out + err
    for robot in robots.values():
        assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    first, second = map(result_of, kantor.runs())
    assert first["digest"] == second["digest"]
    assert second["messages_refused"] == 0
    assert second["violations"] == 0
    site.send_signal(signal.SIGTERM)
    assert site.wait(timeout=EVENT_LIMIT_S) == 143


def test_a_site_relays_its_own_robots_only(place: Place) -> None:
    """A site that was taken over, with a router without rules, speaks for its own robots only."""
    kantor = place.kantor
    world = place.world_sim(*MISSION, "--exchange", "lockstep")
    with place.intruder("site-north", "router", place.hub, place.north) as rogue:
        stolen = hear(rogue, f"{ROOT}/r3/**", f"{ROOT}/observer/**", f"{ROOT}/world/**")
        tokens = [rogue.liveliness().declare_token(f"{ROOT}/r3/alive/forged")]
        robots = place.robots()
        for kind in ("tx", "rx", "pose", "weights"):
            for name in ("r3", "r9", "observer", "worldsim"):
                rogue.put(f"{ROOT}/{name}/{kind}", FORGED, congestion_control=BLOCK)
        rogue.put(f"{ROOT}/r2/tx", b"malformed", congestion_control=BLOCK)
        out, err = world.communicate(timeout=EVENT_LIMIT_S)
        assert drained(stolen) == []
        tokens[0].undeclare()

    assert world.returncode == 0, out + err
    for robot in robots.values():
        assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    result = result_of(kantor.runs()[0])
    assert result["messages_refused"] == 1  # in the name of its own robot
    assert result["violations"] == 0


def test_robots_hold_while_their_site_is_gone(place: Place) -> None:
    """In real time a site's router is killed: its robots leave, and hold. It is started again: they come
    back by themselves, and the mission is done without a violation.
    """
    kantor = place.kantor
    mission = (*MISSION, "energy.points=1500", "energy.steps=1500")
    world = place.world_sim(*mission, "--speed", 4, "--exchange", "wall")
    site = place.site()
    robots = place.robots()
    while not kantor.runs():
        await_line(world, "t=")
    (folder,) = kantor.runs()
    for name in robots:
        await_act(folder, name, after=10)
    os.killpg(site.pid, signal.SIGKILL)
    left = [await_incident(folder, name, "leave") for name in ("r1", "r2")]
    place.site()
    joined = [await_incident(folder, name, "join") for name in ("r1", "r2")]
    out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert world.returncode == 0, out + err
    for robot in robots.values():
        assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    result = result_of(folder)
    assert (result["ended"], result["violations"]) == ("done", 0)
    assert {incident.who for incident in incidents_of(folder)} == {"r1", "r2"}
    records = records_of(folder)
    for leaving, joining in zip(left, joined, strict=True):
        step_records = acts_of(records, leaving.who)
        # The step that was under way is taken in when it is said again.
        assert (
            sum(
                leaving.now_ns < step_record.now_ns < joining.now_ns for step_record in step_records
            )
            <= 1
        )
        assert step_records[-1].now_ns > joining.now_ns
    assert kantor("verify", folder).code == 0


def test_a_site_finds_world_sim_again(place: Place) -> None:
    """World-sim is killed and goes on with its run: the site connects again, and nothing is lost or done twice."""
    kantor = place.kantor
    mission = (*MISSION, "energy.points=6000", "energy.steps=6000", "samples.count=1000")
    assert kantor("run", *mission, "trust=signed", "--exchange", "in-process").code == 0
    world = place.world_sim(*mission, "--exchange", "lockstep")
    site = place.site()
    robots = place.robots()
    while len(kantor.runs()) < 2:
        await_line(world, "t=")
    folder = kantor.runs()[1]
    await_act(folder, "r1", after=20)
    os.killpg(world.pid, signal.SIGKILL)
    await_line(site, place.hub, "not there")
    again = place.world_sim("--resume", folder)
    out, err = again.communicate(timeout=EVENT_LIMIT_S)

    assert again.returncode == 0, out + err
    for robot in robots.values():
        assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    first, second = map(result_of, kantor.runs())
    assert first["digest"] == second["digest"]
    assert second["violations"] == 0
    assert kantor("verify", folder).code == 0
