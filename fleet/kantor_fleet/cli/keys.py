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
    """Issue a fleet's certificates: its private authority, once, and an identity file for each member.

    Run again it keeps existing files and adds missing ones. Give each file to the machine of that member and to
    no other; authority.toml stays here. A changed member list reaches world-sim with its new worldsim.toml.

    Args:
        fleet: Name of the fleet in every key.
        robots: Robots r1 to r<robots>; existing ones stay.
        supervisor: Add the supervisor.
        host: A name or an address by which others reach world-sim, or a site's router: north=10.0.0.5. Any number
            of times. Each certificate has localhost, 127.0.0.1, ::1 and its id anyway.
        site: A site and the robots that connect through it, such as north=r1,r2,r3; any number of times.
        days: Validity of new certificates.
        renew: Issue a new certificate for this member; the old one becomes invalid. Any number of times.
        revoke: Invalidate this member's certificate. Any number of times.
        list: List the certificates and their expiry, and change nothing.
        out: The folder of the authority and the identities.
    """
    from kantor_fleet.security.authority import Wanted, issue, listing, today  # noqa: PLC0415

    if list:
        lines = listing(out, fleet, today())
    else:
        wanted = Wanted(fleet, robots, supervisor, host, site, days, renew, revoke)
        lines = issue(out, wanted, today())
    print("\n".join(lines))
    return Exit.DONE
