"""`kantor compose`: a compose file for a fleet, with a container and an identity for each process.

The templates below are YAML text as a person reads it, in the subset that both Compose v2 and docker-compose 1.29
understand.
"""

import os
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.exits import Exit, fail
from kantor_protocol.transport.endpoint import check_endpoint

ROBOTS_MAX = 500
NETWORKS_MAX = 25
"""Docker's own address pools have room for about thirty networks."""
_PORT = 7447
_USER = 10001
"""User id of the containers if the command is run as root."""
_ID = "r{}"

_HEAD = """\
# {title}
#
#   {command}
#
# KANTOR_SCENARIO   a packaged name, or /runs/FILE.toml for a file in the run folder
# KANTOR_SET        overrides, such as KANTOR_SET='radio.range_m=300 radio.drop=0.2'
# KANTOR_SEED, KANTOR_SPEED, KANTOR_RUNS (folder of the runs), KANTOR_KEYS (folder of the identities),
# KANTOR_USER (uid:gid, the owner of both), KANTOR_IMAGE

x-kantor: &kantor
  image: ${{KANTOR_IMAGE:-kantor}}
  user: ${{KANTOR_USER:-1000:1000}}
  read_only: true
  tmpfs: [/tmp]
  cap_drop: [ALL]
  security_opt: ["no-new-privileges:true"]
  restart: on-failure:10

x-robot: &robot
  <<: *kantor
  mem_limit: ${{KANTOR_MEMORY:-256m}}
  cpus: 1.0
  pids_limit: 64
  environment:
    KANTOR_PORT: {port}
    ZENOH_RUNTIME: "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), rx: (handover: app), net: (handover: app))"
"""
_WORLDSIM = """\
  worldsim:
    <<: *kantor
    command: >-
      worldsim ${{KANTOR_SCENARIO:-{scenario}}} --listen {protocol}/0.0.0.0:{port} --credentials /run/secrets/worldsim.toml
      --seed ${{KANTOR_SEED:-0}} --speed ${{KANTOR_SPEED:-1}} --out /runs --state /state
      --set robots.count={robots} ${{KANTOR_SET:-{overrides}}}
    mem_limit: 2g
    cpus: 2.0
    pids_limit: 256
    stop_grace_period: 30s
    networks: [{networks}]
    secrets: [{{source: worldsim, target: worldsim.toml}}]
    volumes: ["${{KANTOR_RUNS:-./runs}}:/runs", "worldsim:/state"]
"""
_KEYS = """\
  keys:  # makes the identities: docker-compose run --rm keys
    <<: *kantor
    command: keys kantor --robots {robots}{supervisor} --host worldsim --out /keys
    restart: "no"
    network_mode: none
    volumes: ["${{KANTOR_KEYS:-./keys}}:/keys"]
    profiles: [keys]
"""
_PARTICIPANT = """\
  {name}:
    <<: *robot
    command: {verb} --connect {connect} --credentials /run/secrets/{name}.toml --state /state
    networks: [{network}]
    secrets: [{{source: {name}, target: {name}.toml}}]
    volumes: ["{name}:/state"]
"""


class ComposeConfig(NamedTuple):
    """The fleet of a compose file. hub: endpoint of a world-sim elsewhere; without it, world-sim is in the file."""

    robots: int
    supervisor: bool = False
    isolated: bool = False
    scenario: str = "fleet"
    overrides: tuple[str, ...] = ()
    hub: str | None = None


def compose(config: ComposeConfig, file: Path) -> Exit:
    """Write a compose file, and beside it the folders and `.env` that it needs. Raises BusError, ScenarioError, OSError."""
    _check(config)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text(config), encoding="utf-8")
    user = prepare(file.parent)
    print(f"{file}: {config.robots} robots, run by {user}; next, in {file.parent}/:")
    if config.hub is None:
        print("  docker-compose run --rm keys")
    else:
        print("  put each robot's identity into keys/")
    print(f"  {_up(config)}")
    return Exit.DONE


def _check(config: ComposeConfig) -> None:
    if not 1 <= config.robots <= ROBOTS_MAX:
        fail(Exit.USAGE, f"--robots {config.robots}: give 1 to {ROBOTS_MAX}")
    if config.isolated and config.robots > NETWORKS_MAX:
        fail(
            Exit.USAGE,
            f"--isolated: a network for each robot, and Docker has room for {NETWORKS_MAX}",
        )
    if config.hub is not None:
        check_endpoint(config.hub)
        return
    from kantor_fleet.scenarios.catalog import find  # noqa: PLC0415

    if not config.scenario.startswith("/"):  # a file in the run folder
        scenario = find(config.scenario, (f"robots.count={config.robots}", *config.overrides))
        if scenario.centralized and not config.supervisor:
            fail(Exit.USAGE, f"--scenario {config.scenario}: centralized; add --supervisor")


def text(config: ComposeConfig) -> str:
    """The text of the file. The supervisor has a profile of its own, `centralized`."""
    connect = config.hub or f"tls/worldsim:{_PORT}"
    protocol, _, place = connect.partition("/")
    port = place.rpartition(":")[2]
    robots = [_ID.format(i) for i in range(1, config.robots + 1)]
    participants = [*robots, *(["supervisor"] if config.supervisor else [])]
    networks = participants if config.isolated else ["fleet"]
    parts = [_HEAD.format(title=_title(config), command=_up(config), port=port), "\nservices:\n"]
    if config.hub is None:
        overrides = " ".join(config.overrides)
        parts.append(
            _WORLDSIM.format(
                scenario=config.scenario,
                protocol=protocol,
                port=port,
                robots=config.robots,
                overrides=overrides,
                networks=", ".join(networks),
            )
        )
        parts.append(_KEYS.format(robots=config.robots, supervisor=_supervisor_option(config)))
    for name in participants:
        verb = name if name == "supervisor" else f"agent {name}"
        network = name if config.isolated else "fleet"
        parts.append(_PARTICIPANT.format(name=name, verb=verb, connect=connect, network=network))
        if config.hub is None:
            parts.append("    depends_on: [worldsim]\n")
            if name == "supervisor":
                parts.append("    profiles: [centralized]\n")
    owners = participants if config.hub else ["worldsim", *participants]
    # Containers reach nothing beyond their networks, unless the hub is there.
    inside = "internal: false" if config.hub else "internal: true"
    secrets = "".join(
        f'  {who}: {{file: "${{KANTOR_KEYS:-./keys}}/{who}.toml"}}\n' for who in owners
    )
    parts += ["\nnetworks:\n", *(f"  {name}: {{{inside}}}\n" for name in networks)]
    parts += ["\nsecrets:\n", secrets, "\nvolumes:\n", *(f"  {who}: {{}}\n" for who in owners)]
    return "".join(parts)


def _title(config: ComposeConfig) -> str:
    hub = "" if config.hub is None else f", for world-sim at {config.hub}"
    apart = ", each on a network of its own with world-sim" if config.isolated else ""
    return f"{config.robots} robots in containers{apart}{hub}. Written by `kantor compose`."


def _supervisor_option(config: ComposeConfig) -> str:
    return " --supervisor" if config.supervisor else ""


def _up(config: ComposeConfig) -> str:
    if config.hub is not None:
        return "docker-compose up --detach"
    return "docker-compose up --exit-code-from worldsim"


def prepare(folder: Path) -> str:
    """Make the folders of runs and identities, and `.env` with the user of the containers; that user as UID:GID.

    Identities are readable by their owner only and the run folder belongs to the user, so containers run as the user,
    never as root.
    """
    root = os.getuid() == 0
    user = f"{_USER}:{_USER}" if root else f"{os.getuid()}:{os.getgid()}"
    for name in ("runs", "keys"):
        (folder / name).mkdir(exist_ok=True)
        if root:
            os.chown(folder / name, _USER, _USER)
    env = folder / ".env"
    if not env.exists():
        env.write_text(f"COMPOSE_PROJECT_NAME=kantor\nKANTOR_USER={user}\n", encoding="utf-8")
    return user
