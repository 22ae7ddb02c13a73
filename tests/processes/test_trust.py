"""Trust on the real bus: signed over TLS, signed with passwords if it is asked for, and kept by a run that goes on."""

import os
import re
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from kantor_agent.process import run as run_agent
from kantor_fleet.security.authority import Wanted, issue, today
from kantor_protocol.base.machine import Inputs, Outputs
from kantor_protocol.node import runner
from kantor_protocol.node.signing import Signing
from kantor_protocol.transport import credentials
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_protocol.wire.attestations import Identities
from kantor_worldsim.record.records import Opening
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import await_act, await_line, records_of, result_of

if TYPE_CHECKING:
    from support.processes.command import Kantor, Process

MISSION = (
    "fleet", "--seed", 3, "--set", "robots.count=2", "starts.random=true", "starts.poses_m=[]",
    "energy.points=900", "energy.steps=900", "radio.range_m=900",
)  # fmt: skip
SIGNED, OPEN = "trust=signed", "trust=open"
KEYLESS = re.compile(r', key = "[0-9a-f]+"')


def make(folder: Path, **wanted: object) -> None:
    """Issue identities as `kantor keys demo` does."""
    issue(folder, Wanted("demo", **wanted), today())  # type: ignore[arg-type]


def world_sim(kantor: "Kantor", endpoint: str, folder: str, *arguments: object) -> "Process":
    """World-sim, up and waiting."""
    world = kantor.start("worldsim", *arguments, "--listen", endpoint, "--credentials", folder)
    await_line(world, "t=")
    return world


def robots(kantor: "Kantor", endpoint: str, folder: str) -> list["Process"]:
    """r1 and r2."""
    return [
        kantor.start("agent", name, "--connect", endpoint, "--credentials", folder)
        for name in ("r1", "r2")
    ]


def begun(kantor: "Kantor", world: "Process") -> Path:
    """The folder of the run, once it has a record."""
    while not (found := list(kantor.folder.glob("runs/*/run.mcap"))):
        await_line(world, "t=")
    (record,) = found
    return record.parent


def trust_of(folder: Path) -> tuple[str, Identities | None]:
    """What a run has on record of trust."""
    opening, second, *_ = records_of(folder)
    assert isinstance(opening, Opening)
    return str(opening.scenario.trust), second if isinstance(second, Identities) else None


def findings(kantor: "Kantor", folder: Path) -> str:
    """What verify says of a run, without a failure."""
    finished = kantor("verify", folder)
    assert finished.code == 0, finished.out + finished.err
    return finished.out


def attestations(out: str) -> int:
    """How many attestations verify has checked."""
    found = re.search(r"signatures: ([0-9]+) attestations, all signed by their origins", out)
    assert found is not None, out
    return int(found[1])


@pytest.mark.parametrize("asked", [(), (OPEN,)])
def test_over_tls_a_mission_is_signed_by_default(kantor: "Kantor", asked: tuple[str, ...]) -> None:
    """With the keys of the certificates, and the same record as in one process; open if that is asked for."""
    make(kantor.folder / "keys", robots=2)
    endpoint = free_endpoint("tls")
    world = world_sim(kantor, endpoint, "keys", *MISSION, *asked, "--exchange", "lockstep")
    team = robots(kantor, endpoint, "keys")
    out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert world.returncode == 0, out + err
    assert [robot.wait(timeout=EVENT_LIMIT_S) for robot in team] == [0, 0]
    (folder,) = kantor.runs()
    trust, identities = trust_of(folder)
    checked = findings(kantor, folder)
    same = (*asked, SIGNED)[0]
    assert kantor("run", *MISSION, same, "--exchange", "in-process").code == 0
    assert result_of(folder)["digest"] == result_of(kantor.runs()[1])["digest"]
    if asked:
        assert (trust, identities) == ("open", None)
        assert "signatures" not in checked
        return
    assert trust == "signed"
    assert identities is not None
    members = [credentials.find(kantor.folder / "keys", name) for name in ("r1", "r2")]
    assert identities.keys == {each.user: credentials.public_key(each) for each in members}
    assert attestations(checked) > 0


def test_with_an_older_member_list_trust_stays_open(kantor: "Kantor") -> None:
    """One line says so; signed was asked for: one line, and nothing else; then `kantor keys` is run again."""
    folder, endpoint = kantor.folder / "keys", free_endpoint("tls")
    make(folder, robots=2)
    for name in ("authority", "worldsim"):
        path = folder / f"{name}.toml"
        path.write_text(KEYLESS.sub("", path.read_text()))
    place = ("--listen", endpoint, "--credentials", "keys")
    refused = kantor("worldsim", *MISSION, SIGNED, *place)
    world = world_sim(kantor, endpoint, "keys", *MISSION)
    world.send_signal(signal.SIGINT)
    _, err = world.communicate(timeout=EVENT_LIMIT_S)

    remedy = (
        "the register has no key of r1 and 1 more; `kantor keys demo` adds those whose files are beside it, "
        "and `--renew r1` makes one"
    )
    assert (refused.code, refused.err) == (2, f'kantor: trust = "signed": {remedy}\n')
    assert [line for line in err.splitlines() if "trust" in line] == [
        f"kantor: warning: trust stays open: {remedy}"
    ]
    assert kantor("keys", "demo").code == 0
    world = world_sim(kantor, endpoint, "keys", *MISSION)
    world.send_signal(signal.SIGINT)
    assert "trust" not in world.communicate(timeout=EVENT_LIMIT_S)[1]


@pytest.mark.parametrize("exchange", ["in-process", "lockstep", "realtime"])
def test_a_signed_run_on_this_machine(kantor: "Kantor", exchange: str) -> None:
    """In each exchange, also where everything happens to processes; in lockstep the digest is that of one process."""
    (kantor.folder / "chaos.toml").write_text(CHAOS)
    command = ("fleet", "--chaos", "chaos.toml", "--set", "limit_s=14", "radio.range_m=500", SIGNED)
    finished = kantor("run", *command, "--exchange", exchange, "--speed", 2)

    assert "all rules held" in finished.out, finished.out + finished.err
    (folder,) = kantor.runs()
    trust, identities = trust_of(folder)
    assert trust == "signed"
    assert identities is not None
    assert set(identities.keys) == {"r1", "r2", "r3", "r4", "r5"}
    assert attestations(findings(kantor, folder)) > 0
    if exchange == "lockstep":
        kantor("run", *command, "--exchange", "in-process")
        other = kantor.runs()[1]
        assert result_of(folder)["digest"] == result_of(other)["digest"]
        _, seeded = trust_of(other)
        assert seeded is not None
        assert not set(seeded.keys.values()) & set(identities.keys.values())


CHAOS = """
[[faults]]
kind = "kill"
who = ["r2"]
from_s = 3.0
until_s = 5.0
disk = "lost"

[[faults]]
kind = "kill"
who = ["r1"]
from_s = 4.0
until_s = 6.0
mid_step = true

[[faults]]
kind = "kill"
who = ["worldsim"]
from_s = 7.0
until_s = 7.5

[[faults]]
kind = "late"
who = ["r4"]
until_s = 2.0
"""


@pytest.mark.parametrize("exchange", ["lockstep", "realtime"])
def test_a_signed_run_goes_on_with_its_keys(kantor: "Kantor", exchange: str) -> None:
    """World-sim is killed and resumes: the robots that wait for it sign as before. With other passwords it does not."""
    endpoint = free_endpoint()
    mission = (*MISSION, "energy.points=4000", "energy.steps=4000", "samples.count=1000", SIGNED)
    pace = () if exchange == "lockstep" else ("--speed", 8)
    world = world_sim(kantor, endpoint, "secrets", *mission, "--exchange", exchange, *pace)
    team = robots(kantor, endpoint, "secrets")
    folder = begun(kantor, world)
    await_act(folder, "r1", after=40)
    os.killpg(world.pid, signal.SIGKILL)
    world.wait()
    before = trust_of(folder)

    place = ("--listen", endpoint, "--credentials")
    refused = kantor("worldsim", "--resume", folder, *place, "others")
    assert (refused.code, refused.err) == (
        2,
        (
            "kantor: the run on record is signed with other keys; give the --credentials that it began "
            "with\n"
        ),
    )
    again = kantor.start("worldsim", "--resume", folder, *place, "secrets")
    out, err = again.communicate(timeout=EVENT_LIMIT_S)

    assert again.returncode == 0, out + err
    assert [robot.wait(timeout=EVENT_LIMIT_S) for robot in team] == [0, 0]
    assert trust_of(folder) == before
    result = result_of(folder)
    assert (result["ended"], result["violations"], result["refused_reports"]) == ("done", 0, {})
    assert attestations(findings(kantor, folder)) > 0


def test_a_robot_whose_certificate_was_renewed_takes_no_more_part(kantor: "Kantor") -> None:
    """World-sim goes on and says so; the robot is told in one line; the other one ends the mission."""
    folder, endpoint = kantor.folder / "keys", free_endpoint("tls")
    make(folder, robots=2)
    world = world_sim(kantor, endpoint, "keys", *MISSION, "--exchange", "lockstep")
    team = robots(kantor, endpoint, "keys")
    run = begun(kantor, world)
    await_act(run, "r2", after=20)
    for process in (world, *team):
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    make(folder, renew=("r2",))
    again = kantor.start("worldsim", "--resume", run, "--listen", endpoint, "--credentials", "keys")
    await_line(again, "t=")
    one, other = robots(kantor, endpoint, "keys")
    told = other.communicate(timeout=EVENT_LIMIT_S)[1]
    out, err = again.communicate(timeout=EVENT_LIMIT_S)

    assert other.returncode == 2
    assert told.splitlines() == [
        (
            "kantor: r2: this mission knows it by another key; use the credentials that the mission began with, "
            "or begin another"
        )
    ]
    assert again.returncode in {0, 1}, out + err
    assert one.wait(timeout=EVENT_LIMIT_S) == 0
    assert "r2 has another key than on record, and can take no more part" in err
    assert "all signed by their origins" in findings(kantor, run)


class Mute(Signing):
    """A robot's process that leaves its signatures empty."""

    def step(self, inputs: Inputs, /) -> Outputs:
        """Make one step."""
        return self._machine.step(inputs)


def test_a_robot_that_does_not_sign_is_named(
    kantor: "Kantor", monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its reports are refused, world-sim says so in one line, and the other robot goes on without it."""
    endpoint = free_endpoint()
    mission = (*MISSION, "limit_s=12", "radio.range_m=3000", SIGNED, "--exchange", "lockstep")
    world = world_sim(kantor, endpoint, "secrets", *mission)
    identity = credentials.find(kantor.folder / "secrets", "r2")
    monkeypatch.setattr(runner, "Signing", Mute)
    with ThreadPoolExecutor(1) as pool:
        mute = pool.submit(
            run_agent, endpoint, identity, EVENT_LIMIT_S, lambda _line: None, kantor.folder / "r2"
        )
        place = ("--connect", endpoint, "--credentials", "secrets")
        honest = kantor.start("agent", "r1", *place)
        out, err = world.communicate(timeout=EVENT_LIMIT_S)
        assert mute.result(EVENT_LIMIT_S) == "limit"

    assert world.returncode == 1, out + err
    assert honest.wait(timeout=EVENT_LIMIT_S) == 0
    reason = "an attestation that r2 has not signed"
    assert out.count(f"r2 sends what it cannot, and it is not taken in: {reason}") == 1
    (folder,) = kantor.runs()
    refused = result_of(folder)["refused_reports"]
    assert isinstance(refused, dict)
    assert (set(refused), refused["r2"]["reasons"]) == ({"r2"}, [reason])
    assert "all signed by their origins" in findings(kantor, folder)


def test_a_signed_run_of_one_process_does_not_go_on_over_the_bus(kantor: "Kantor") -> None:
    """Its keys follow from the seed; nothing is written."""
    run = kantor.start(
        "run",
        *MISSION,
        "energy.points=90000",
        "energy.steps=90000",
        SIGNED,
        "--exchange",
        "in-process",
    )
    while not list(kantor.folder.glob("runs/*/run.mcap")):
        assert run.poll() is None
    (folder,) = kantor.runs()
    await_act(folder, "r1", after=5)
    os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    before = (folder / "run.mcap").read_bytes()
    refused = kantor("worldsim", "--resume", folder, "--listen", free_endpoint())

    assert (refused.code, refused.err) == (
        2,
        f"kantor: {folder}: a signed run of one process has keys that no other process has; start it anew\n",
    )
    assert (folder / "run.mcap").read_bytes() == before
