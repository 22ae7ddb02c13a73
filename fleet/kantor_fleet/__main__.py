"""The `kantor` command."""

import contextlib
import io
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import tyro

from kantor_fleet.cli.agent import agent
from kantor_fleet.cli.campaign import campaign
from kantor_fleet.cli.chaos import chaos
from kantor_fleet.cli.compose import compose
from kantor_fleet.cli.keys import keys
from kantor_fleet.cli.reproduce import reproduce
from kantor_fleet.cli.run import run
from kantor_fleet.cli.scenarios import scenarios
from kantor_fleet.cli.site import site
from kantor_fleet.cli.supervisor import supervisor
from kantor_fleet.cli.sweep import sweep
from kantor_fleet.cli.tap import tap
from kantor_fleet.cli.verify import verify
from kantor_fleet.cli.worldsim import worldsim
from kantor_fleet.exits import Exit, fail, warn
from kantor_fleet.interrupts import Interrupted
from kantor_fleet.output import Output

VERBS: dict[str, Callable[..., int]] = {
    "run": run,
    "worldsim": worldsim,
    "agent": agent,
    "supervisor": supervisor,
    "site": site,
    "sweep": sweep,
    "campaign": campaign,
    "scenarios": scenarios,
    "verify": verify,
    "reproduce": reproduce,
    "tap": tap,
    "compose": compose,
    "chaos": chaos,
    "keys": keys,
}


_TEXT_MAX = 200
"""Characters of an exception that no one expected."""
MISSIONS = frozenset(
    {"run", "worldsim", "agent", "supervisor", "site", "sweep", "campaign", "reproduce"}
)
"""Verbs whose outcome is elsewhere than in what they print."""


def main() -> None:
    """Entry point: one verb, one exit code, and one line instead of a traceback for a user's mistake."""
    output = Output()
    arguments = _spread_repeated(sys.argv[1:])
    try:
        code = _code(arguments)
        printed = arguments[:1] == [] or arguments[0] not in MISSIONS
    except SystemExit as ended:  # with its one line, or after help
        if ended.code:
            raise
        code, printed = Exit.DONE, True
    sys.stdout.flush()
    if output.error is not None and not output.unread:
        warn([f"standard output: {output.error}; what was printed is lost"])
        code = code or (Exit.USAGE if printed else Exit.DONE)
    sys.exit(code)


def _code(arguments: list[str]) -> int:
    """Run a command line; the exit code. Raises SystemExit."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        with contextlib.suppress(OSError):  # another stream may have taken its place
            sys.stdout.reconfigure(errors="surrogateescape")  # names of files may be any bytes
    try:
        return _run(arguments)
    except Interrupted as interrupted:
        return interrupted.code
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    except Exception as error:  # noqa: BLE001  whatever it is, it is one line
        fail(*_failure(error))


def _failure(error: Exception) -> tuple[Exit, str]:
    """The exit code and the line for an exception. Its kinds are imported here: a short command needs none of them."""
    from kantor_fleet.execution.fork_server import StartError  # noqa: PLC0415
    from kantor_protocol.scenario.errors import ScenarioError  # noqa: PLC0415
    from kantor_protocol.transport.credentials import CredentialsError  # noqa: PLC0415
    from kantor_protocol.transport.session import BusError  # noqa: PLC0415

    match error:
        case ScenarioError() | CredentialsError():
            return Exit.USAGE, str(error)
        case BusError():
            return Exit.UNREACHABLE, str(error)
        case StartError():
            return Exit.PROCESS_FAILED, str(error)
        case OSError():
            return Exit.USAGE, f"{error.filename or 'file'}: {error.strerror or error}"
        case _:
            return Exit.PROCESS_FAILED, _crash(error)


def _crash(error: Exception) -> str:
    """An exception that no one expected, with its place."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    text = " ".join(str(error).split())[:_TEXT_MAX]
    place = f"{Path(frame.filename).name}:{frame.lineno}"
    return f"crashed at {place}: {type(error).__name__}: {text}; please report this"


def _run(arguments: list[str]) -> int:
    """Parse the command line and run its verb; the exit code."""
    code: int
    name = arguments[0] if arguments else ""
    if name in VERBS:  # the parsers of all verbs together take longer than a short command
        code = tyro.cli(VERBS[name], prog=f"kantor {name}", args=arguments[1:])
    else:
        code = tyro.extras.subcommand_cli_from_dict(
            VERBS,
            prog="kantor",
            description="Fleets of robot processes on the Zenoh bus that explore together.",
            args=arguments,
        )
    return code


_REPEATED = ("--set", "--vary")
_REPEATED_WORDS = ("--only",)
"""Likewise; `kantor tap` alone has it, and takes no other words."""


def _spread_repeated(arguments: list[str]) -> list[str]:
    """`--set a=1 b=2` as `--set a=1 --set b=2`, and `--vary` and `--only` likewise."""
    spread: list[str] = []
    flag = None
    for argument in arguments:
        goes_on = "=" in argument or flag in _REPEATED_WORDS
        if flag and goes_on and not argument.startswith("-") and spread[-1] != flag:
            spread.append(flag)
        elif argument.startswith("-") or spread[-1:] != [flag]:
            flag = argument if argument in _REPEATED + _REPEATED_WORDS else None
        spread.append(argument)
    return spread


if __name__ == "__main__":
    main()
