"""`kantor site`: its options and their checks."""

from pathlib import Path
from typing import Annotated

import tyro


def site(
    name: Annotated[str, tyro.conf.Positional],
    /,
    connect: str = "tls/127.0.0.1:7447",
    listen: str = "tls/0.0.0.0:7447",
    credentials: Path = Path("keys"),
    patience: float = 60.0,
) -> int:
    """Run the router of a site: the robots of one place connect to it, and it connects to world-sim.

    It relays messages of its own robots only, those that `kantor keys --site` assigns to it, and stores nothing.

    Args:
        name: Which site, such as north.
        connect: World-sim's endpoint, tls/HOST:PORT.
        listen: Endpoint for the site's robots.
        credentials: The folder of identities, or this site's file.
        patience: Seconds to wait for world-sim.
    """
    from kantor_fleet.processes.site import serve  # noqa: PLC0415

    return serve(name, connect, listen, credentials, patience)
