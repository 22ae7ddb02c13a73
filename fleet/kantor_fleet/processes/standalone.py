"""Processes started one by one, each in its own terminal or on its own machine."""

from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec import UNSET

from kantor_fleet.exits import Exit, fail, warn
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.processes import resume_pointer
from kantor_protocol.base.machine import SUPERVISOR, ParticipantId
from kantor_protocol.node.runner import RejectedError, StateError
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport import credentials
from kantor_protocol.transport.credentials import (
    FLEET_PATTERN,
    Certificate,
    CredentialsError,
    Identity,
)
from kantor_protocol.transport.endpoint import await_endpoint, check_endpoint, is_tls
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.session import be_light
from kantor_protocol.transport.zenoh_log import host_log, init_log
from kantor_protocol.wire.attestations import Identities

if TYPE_CHECKING:
    from kantor_worldsim.exchange.config import MissionConfig
    from kantor_worldsim.observers.recording import Recording
    from kantor_worldsim.record.run_folder import Past

_FLEET = "kantor"
RunParticipant = Callable[[str, Identity, float, Callable[[str], None], Path], str]


def host_standalone(
    scenario: Scenario,
    seed: int,
    exchange: str,
    speed: float,
    listen: str,
    secrets: Path,
    fleet: str | None,
    start_after_s: float | None,
    out: Path,
    exact_every: int | None,
    state: Path | None = None,
) -> Exit:
    """Run world-sim in this terminal, for a new run. Raises ScenarioError, BusError, OSError.

    exchange: its name on record. state: the folder of the pointer to the run.
    """
    from kantor_worldsim.exchange.config import MissionConfig  # noqa: PLC0415  standalone robots do not need these
    from kantor_worldsim.observers.recording import Recording  # noqa: PLC0415
    from kantor_worldsim.record.run_folder import FolderLock, folder_for  # noqa: PLC0415
    from kantor_worldsim.world.world import WorldSetup  # noqa: PLC0415

    _check_faults(scenario, exchange)
    setup = WorldSetup.of(scenario, seed)
    warn(setup.warnings)
    plan = MissionConfig(scenario, seed, setup, exchange, speed, start_after_s)

    with ExitStack() as stack:

        def record(mission: Scenario) -> tuple[Path, "Recording"]:
            folder = folder_for(mission, seed, out)
            stack.enter_context(FolderLock(folder))
            if state is not None:
                resume_pointer.note(state, folder)
            return folder, Recording(mission, seed, exchange, folder, exact_every, speed=speed)

        return _host(plan, listen, secrets, fleet, record)


def resume_standalone(folder: Path, listen: str, secrets: Path, fleet: str | None) -> Exit:
    """Run world-sim in this terminal, for a run that was cut short. Raises BusError, OSError."""
    from kantor_worldsim.record.run_folder import FolderLock, Past, ResumeError  # noqa: PLC0415

    try:
        with FolderLock(folder):
            return _go_on(folder, Past.of(folder), listen, secrets, fleet)
    except ResumeError as error:
        fail(Exit.USAGE, str(error))


def _go_on(folder: Path, past: "Past", listen: str, secrets: Path, fleet: str | None) -> Exit:
    from kantor_worldsim.exchange.config import MissionConfig  # noqa: PLC0415
    from kantor_worldsim.observers.recording import Recording  # noqa: PLC0415

    terms, opening = past.terms, past.opening
    scenario, seed, exchange = opening.scenario, opening.seed, terms.exchange
    _check_faults(scenario, exchange)
    _check_resumable(folder, past)
    plan = MissionConfig(scenario, seed, opening.setup, exchange, terms.speed)

    def record(mission: Scenario) -> tuple[Path, "Recording"]:
        every = terms.exact_every
        return folder, Recording(mission, seed, exchange, folder, every, past=past)

    return _host(plan, listen, secrets, fleet, record, past)


def _check_resumable(folder: Path, past: "Past") -> None:
    """Fail with one line, before anything is written, unless the mission can be rebuilt from its records."""
    from kantor_worldsim.engine.simulation import Simulation  # noqa: PLC0415

    opening = past.opening
    if past.terms.exchange == "in-process" and past.identities is not None:
        fail(
            Exit.USAGE,
            f"{folder}: a signed run of one process has keys that no other process has; start it anew",
        )
    try:
        Simulation.resumed(opening.scenario, opening.seed, opening.setup, past.records, ())
    except ValueError as error:  # of another version, or not usable
        problem = str(error).splitlines()[0]
        fail(
            Exit.USAGE,
            f"{folder}: cannot go on with this version ({problem}); resume it with the one that wrote it, or start a new run",
        )


def go_on_standalone(state: Path, listen: str, secrets: Path, fleet: str | None) -> Exit | None:
    """Run world-sim in this terminal, for the run that its state folder points to; None if a new run is to begin.

    A mission that was not met is not run again: a container engine would restart it for ever.
    """
    from kantor_worldsim.record.run_folder import FolderLock, InUseError, ResumeError  # noqa: PLC0415

    folder = resume_pointer.run_in(state)
    if folder is None:
        return None
    try:
        with FolderLock(folder):
            return _go_on_pointed(folder, listen, secrets, fleet)
    except InUseError as error:
        fail(Exit.USAGE, str(error))
    except ResumeError:  # there is no folder, or no step was recorded in it
        return None


def _go_on_pointed(folder: Path, listen: str, secrets: Path, fleet: str | None) -> Exit | None:
    """See `go_on_standalone`. Raises ResumeError."""
    from kantor_fleet.report.summary import conclude, exit_code_of, read_result  # noqa: PLC0415
    from kantor_worldsim.record.run_folder import REPORT, OverError, Past  # noqa: PLC0415

    try:
        past = Past.of(folder)
    except OverError as over:
        result = read_result(folder)
        code = Exit.PROCESS_FAILED if result is None else exit_code_of(result)
        if not (folder / REPORT).exists():  # world-sim was killed after the end of the mission
            conclude(folder)
            return code
        if code is not Exit.DONE:
            warn([f"{over}, and was not met; a new container begins another run"])
        return code or None
    return _go_on(folder, past, listen, secrets, fleet)


def _check_faults(scenario: Scenario, exchange: str) -> None:
    from kantor_worldsim.exchange.config import needs_process_control  # noqa: PLC0415

    if (fault := needs_process_control(scenario, exchange)) is not None:
        fail(
            Exit.USAGE,
            f"{fault}: needs control over the processes of participants; use `kantor run`",
        )


def _host(
    plan: "MissionConfig",
    listen: str,
    secrets: Path,
    fleet: str | None,
    record: "Callable[[Scenario], tuple[Path, Recording]]",
    past: "Past | None" = None,
) -> Exit:
    """Host a mission. record: opens the run folder of the mission once the bus is up."""
    from kantor_fleet.execution.preload import kinds_of, warm_up  # noqa: PLC0415  standalone robots do not need these
    from kantor_fleet.report.progress import ProgressView  # noqa: PLC0415
    from kantor_fleet.report.summary import conclude, exit_code_of, read_result  # noqa: PLC0415
    from kantor_worldsim.exchange.main import run  # noqa: PLC0415

    identity, keys = _host_identity(listen, secrets, fleet, plan.scenario)
    if past is None:
        plan = _with_trust(plan, identity, keys)
    elif past.identities is not None:
        _check_keys(past.identities, keys)
    scenario = plan.scenario
    with (
        host_log(identity, lambda line: view.note(line)),  # noqa: PLW0108  view is defined below
        Interrupts() as interrupts,
        ProgressView(scenario.name) as view,
    ):
        with interrupts.at_once():
            warm_up(kinds_of(scenario))
        users = credentials.users_file(secrets)
        with HubRouter(identity, listen, users, scenario.roster, view.note) as host:
            folder, recording = record(scenario)
            view.note(f"world-sim of fleet {identity.fleet} at {listen}, credentials in {secrets}")
            for name in scenario.roster:
                view.note(f"  {_joining(name, listen, secrets)}")
            run(host, plan, recording, interrupts, view.show, past, say=view.note)
    with Interrupts(patient=True):  # the mission is over, and its code is decided
        conclude(folder)
    result = read_result(folder)
    if result is not None and result.ended == "done":
        return exit_code_of(result)
    return interrupts.code or (exit_code_of(result) if result is not None else Exit.PROCESS_FAILED)


def _joining(name: ParticipantId, listen: str, secrets: Path) -> str:
    """The command with which a participant joins from its machine, with HOST for an unspecified address."""
    verb = name if name == SUPERVISOR else f"agent {name}"
    endpoint = listen.replace("/0.0.0.0:", "/HOST:").replace("/[::]:", "/HOST:")
    own = secrets if secrets.is_dir() else secrets.with_name(f"{name}.toml")
    file = own if own.exists() else own.name  # it is on the robot's machine
    return f"kantor {verb} --connect {endpoint} --credentials {file}"


def _with_trust(
    plan: "MissionConfig", identity: Identity, keys: dict[ParticipantId, bytes]
) -> "MissionConfig":
    """The plan with the keys of a signed mission; by default it is one over TLS. Raises CredentialsError.

    keys: of the roster, empty where there is none.
    """
    scenario, members = plan.scenario, getattr(identity, "members", {})
    unknown = [name for name in scenario.roster if not keys[name] and name in members]
    if scenario.trust is UNSET and isinstance(identity, Certificate):
        if unknown:
            warn([f"trust stays open: {_no_keys(identity, unknown)}"])
            return plan
        scenario = msgspec.structs.replace(scenario, trust="signed")
    if scenario.signed and unknown:
        raise CredentialsError(f'trust = "signed": {_no_keys(identity, unknown)}')
    return plan._replace(scenario=scenario, keys=keys if scenario.signed else {})


def _no_keys(identity: Identity, names: list[ParticipantId]) -> str:
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return (
        f"the register has no key of {names[0]}{more}; `kantor keys {identity.fleet}` adds those whose files "
        f"are beside it, and `--renew {names[0]}` makes one"
    )


def _check_keys(identities: Identities, keys: dict[ParticipantId, bytes]) -> None:
    """Compare the keys of a run that goes on with those of today's credentials. Raises CredentialsError.

    A run keeps its keys: what was signed before must count.
    """
    known = [name for name in identities.keys if keys[name]]
    other = [name for name in known if keys[name] != identities.keys[name]]
    if other and other == known:
        raise CredentialsError(
            "the run on record is signed with other keys; give the --credentials that it began with"
        )
    warn(f"{name} has another key than on record, and can take no more part" for name in other)


def _host_identity(
    listen: str, place: Path, fleet: str | None, scenario: Scenario
) -> tuple[Identity, dict[ParticipantId, bytes]]:
    """World-sim's identity for a mission with this roster, and the roster's public keys, as far as they are known.

    Missing passwords are issued here; certificates never are. Raises BusError, CredentialsError.
    """
    if not is_tls(listen):
        name = fleet or _FLEET
        if not FLEET_PATTERN.fullmatch(name):
            fail(Exit.USAGE, f"--fleet {name}: use lower-case letters, digits and dashes")
        issued = credentials.issue(place, name, scenario.roster)
        keys = {user: credentials.public_key(issued[user]) for user in scenario.roster}
        return issued[credentials.HOST], keys
    identity = credentials.find(place, credentials.HOST)
    check_endpoint(listen, identity)
    if not isinstance(identity, Certificate):
        raise TypeError(identity)  # pragma: no cover  check_endpoint has refused it
    if fleet not in {None, identity.fleet}:
        fail(
            Exit.USAGE, f"--fleet {fleet}: {place} is of fleet {identity.fleet}; leave --fleet out"
        )
    _check_members(identity, scenario, place)
    warn(identity.warnings((*scenario.roster, credentials.OBSERVER), datetime.now(UTC)))
    return identity, identity.public_keys(scenario.roster)


def _check_members(identity: Certificate, scenario: Scenario, place: Path) -> None:
    """Check that every participant has a certificate, or had one that was revoked. Raises CredentialsError."""
    withdrawn = {name.partition(".")[0] for name in identity.revoked}
    missing = [name for name in scenario.roster if name not in identity.members]
    for name in missing:
        if name not in withdrawn:
            option = "--supervisor" if name == SUPERVISOR else f"--robots {len(scenario.robot_ids)}"
            raise CredentialsError(
                f"{place}: the register has no {name}; `kantor keys {identity.fleet} {option}`"
            )
    warn(f"{name} is revoked and will be refused" for name in missing)


def participate_standalone(
    run: RunParticipant,
    name: ParticipantId,
    connect: str,
    place: Path,
    connect_timeout_s: float,
    state: Path,
) -> Exit:
    """Run a participant in this terminal. Raises BusError, CredentialsError."""
    # A robot may start before world-sim, which writes the passwords: read them once it is up.
    if not is_tls(connect) and (not place.exists() or place.is_dir()):
        await_endpoint(connect, connect_timeout_s)
    identity = credentials.find(place, name)
    init_log()
    be_light()

    def log(line: str) -> None:
        print(line, flush=True)

    try:
        reason = run(connect, identity, connect_timeout_s, log, state)
    except (RejectedError, StateError) as error:
        fail(Exit.USAGE, str(error))
    log(f"{name}: mission over: {reason}")
    return Exit.DONE
