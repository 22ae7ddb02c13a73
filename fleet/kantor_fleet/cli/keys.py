"""`kantor keys`: its options and their checks."""

from pathlib import Path
from typing import Annotated

import tyro

from kantor_fleet.exits import Exit


def keys(
    fleet: Annotated[str, tyro.conf.Positional],
    /,
    *,
    robots: int = 0,
    supervisor: bool = False,
    host: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    site: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    days: int = 365,
    renew: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    revoke: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    list: bool = False,  # noqa: A002  the flag is --list
    out: Path = Path("keys"),
) -> int:
    """Make a fleet's certificates: its private authority, once, and a file for each member.

    Run again it keeps what there is and adds what is missing. Hand each file to whoever runs that member, and to
    nobody else; authority.toml stays. What has changed in the register reaches world-sim with worldsim.toml.

    Args:
        fleet: Name of the fleet in every key.
        robots: Robots r1 to r<robots>; those that there are stay.
        supervisor: Also the supervisor.
        host: A name or an address by which others reach world-sim, or a site's router: north=10.0.0.5. Any number
            of times. Each has localhost, 127.0.0.1, ::1 and its id anyway.
        site: A site and the robots that stand behind it, such as north=r1,r2,r3; any number of times.
        days: How long the new certificates count.
        renew: Make a new certificate for this member; the old one ceases to count. Any number of times.
        revoke: This member's certificate ceases to count. Any number of times.
        list: Say which certificates there are, and until when they count; nothing is made.
        out: The folder.
    """
    from kantor_fleet.security.authority import Wanted, issue, listing, today  # noqa: PLC0415

    if list:
        lines = listing(out, fleet, today())
    else:
        wanted = Wanted(fleet, robots, supervisor, host, site, days, renew, revoke)
        lines = issue(out, wanted, today())
    print("\n".join(lines))
    return Exit.DONE
