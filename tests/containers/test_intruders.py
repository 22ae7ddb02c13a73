"""Strangers in a container on the fleet's own network: none gets a message in or out."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from containers.engine import IMAGE, Fleet, keys
from kantor_fleet.processes.compose import ComposeConfig
from kantor_fleet.security.authority import Wanted
from support.limits import EVENT_LIMIT_S

pytestmark = pytest.mark.xdist_group("containers")

MakeFleet = Callable[..., Fleet]

INTRUDER = """
import base64, json, sys, time, tomllib
import zenoh
tree = tomllib.load(open(sys.argv[1], "rb"))
config = zenoh.Config()
settings = {
    "mode": "client",
    "connect/endpoints": ["tls/worldsim:7447"],
    "connect/timeout_ms": 3000,
    "scouting/multicast/enabled": False,
    "transport/link/tls/root_ca_certificate_base64": base64.b64encode(tree["authority"].encode()).decode(),
}
if sys.argv[2] == "certificate":
    settings |= {
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/connect_private_key_base64": base64.b64encode(tree["key"].encode()).decode(),
        "transport/link/tls/connect_certificate_base64": base64.b64encode(tree["certificate"].encode()).decode(),
    }
for key, value in settings.items():
    config.insert_json5(key, json.dumps(value))
try:
    session = zenoh.open(config)
except zenoh.ZError:
    print("refused")
    sys.exit()
heard = []
held = [session.declare_subscriber(key, heard.append) for key in ("kantor/v1/kantor/r1/**", "kantor/v1/**", "**")]
for _ in range(50):
    session.put("kantor/v1/kantor/r1/tx", b"forged")
    session.put("kantor/v1/kantor/r1/rx", b"forged")
    time.sleep(0.05)
# Its own rx it may read, and what it puts itself comes back within its session.
print("in", sum("/r2/" not in str(s.key_expr) and s.payload.to_bytes() != b"forged" for s in heard))
session.close()
"""


def run(fleet: Fleet, folder: Path, *command: object) -> "subprocess.CompletedProcess[str]":
    """A container of a stranger's on the network of a fleet; its folder is at /stolen."""
    return subprocess.run(
        [
            "docker", "run", "--rm", "--network", f"{fleet.project}_fleet", "--user", "10001:10001",
            "--volume", f"{folder}:/stolen:ro", *map(str, command),
        ],
        capture_output=True, text=True, check=False, timeout=EVENT_LIMIT_S,
    )  # fmt: skip


def test_intruders_on_the_network_are_refused(fleet_of: MakeFleet, tmp_path: Path) -> None:
    """No certificate, a foreign authority's, another robot's: refused, with a line on both sides, or heard by no process."""
    fleet = fleet_of(ComposeConfig(2), set="starts.random=true radio.range_m=800")
    fleet.compose("up", "--detach")
    fleet.await_log("worldsim", "explored")
    stolen = fleet.folder / "keys"
    foreign = tmp_path / "foreign"
    keys(foreign, Wanted("kantor", 2))

    def raw(folder: Path, name: str, proof: str) -> str:
        command = ("--entrypoint", "python3", IMAGE, "-c", INTRUDER, f"/stolen/{name}.toml", proof)
        done = run(fleet, folder, *command)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def agent(folder: Path, file: str) -> "subprocess.CompletedProcess[str]":
        door = ("--connect", "tls/worldsim:7447", "--state", "/state", "--patience", 5)
        return run(fleet, folder, IMAGE, "agent", "r1", "--credentials", f"/stolen/{file}", *door)

    assert raw(stolen, "r2", "nothing") == "refused"
    assert raw(foreign, "r2", "certificate") == "refused"
    assert raw(stolen, "r2", "certificate") == "in 0"

    stranger = agent(foreign, "r1.toml")
    assert stranger.returncode == 4, stranger.stderr
    assert len(stranger.stderr.splitlines()) == 1
    impostor = agent(stolen, "r2.toml")
    assert impostor.returncode == 2
    assert "credentials of r2, not of r1" in impostor.stderr
    assert fleet.inspect("r1")["RestartCount"] == fleet.inspect("r2")["RestartCount"] == 0
    log = fleet.log("worldsim")
    assert "leave" not in log
    assert "refused a client: it showed no certificate" in log
    assert "refused a client: it trusts another authority than world-sim's" in log
