"""The `kantor` command."""

import contextlib
import io
import sys
from collections.abc import Callable

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
from kantor_fleet.exits import Exit, fail
from kantor_fleet.interrupts import Interrupted

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


def main() -> None:
    """Entry point: one verb, one exit code, and one line instead of a traceback for a user's mistake."""
    from kantor_fleet.execution.fork_server import StartError  # noqa: PLC0415
    from kantor_protocol.scenario.errors import ScenarioError  # noqa: PLC0415
    from kantor_protocol.transport.credentials import CredentialsError  # noqa: PLC0415
    from kantor_protocol.transport.session import BusError  # noqa: PLC0415

    if isinstance(sys.stdout, io.TextIOWrapper):
        with contextlib.suppress(OSError):  # another stream may have taken its place
            sys.stdout.reconfigure(errors="surrogateescape")  # names of files may be any bytes
    try:
        code = _run(_spread_repeated(sys.argv[1:]))
    except (ScenarioError, CredentialsError) as error:
        fail(Exit.USAGE, str(error))
    except BusError as error:
        fail(Exit.UNREACHABLE, str(error))
    except StartError as error:
        fail(Exit.PROCESS_FAILED, str(error))
    except BrokenPipeError:
        sys.stderr.close()
        code = Exit.DONE
    except OSError as error:
        fail(Exit.USAGE, f"{error.filename or 'file'}: {error.strerror or error}")
    except Interrupted as interrupted:
        code = interrupted.code
    except KeyboardInterrupt:
        code = Exit.INTERRUPTED
    sys.exit(code)


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


def _spread_repeated(arguments: list[str]) -> list[str]:
    """`--set a=1 b=2` as `--set a=1 --set b=2`, and `--vary` likewise."""
    spread: list[str] = []
    flag = None
    for argument in arguments:
        if flag and "=" in argument and not argument.startswith("-") and spread[-1] != flag:
            spread.append(flag)
        elif argument.startswith("-") or spread[-1:] != [flag]:
            flag = argument if argument in _REPEATED else None
        spread.append(argument)
    return spread


if __name__ == "__main__":
    main()
