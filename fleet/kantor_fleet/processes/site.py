"""`kantor site`: the router for the robots of one place."""

from pathlib import Path

from kantor_fleet.exits import Exit, fail
from kantor_fleet.interrupts import Interrupts
from kantor_protocol.transport import credentials
from kantor_protocol.transport.credentials import Certificate
from kantor_protocol.transport.endpoint import check_endpoint
from kantor_protocol.transport.events import Joined, Left
from kantor_protocol.transport.router import SiteRouter
from kantor_protocol.transport.zenoh_log import host_log

_POLL_S = 0.2
"""From one check of the connection to the next."""


def serve(name: str, connect: str, listen: str, place: Path, connect_timeout_s: float) -> Exit:
    """Serve the site until a signal arrives. Raises BusError, CredentialsError."""
    identity = credentials.find(place, f"site-{name}")
    for endpoint in (connect, listen):
        check_endpoint(endpoint, identity)
    if not isinstance(identity, Certificate):
        fail(Exit.USAGE, f"{place}: a password; a site needs a certificate of `kantor keys --site`")
    with (
        host_log(identity, _log),
        Interrupts() as interrupts,
        SiteRouter(identity, connect, listen, connect_timeout_s, _log) as site,
    ):
        _log(f"site {name} at {listen}, for {', '.join(site.members)}")
        connected = False
        while not interrupts():
            if site.connected is not connected:
                connected = not connected
                _log(f"{connect}: {'connected' if connected else 'not there'}")
            event = site.next(_POLL_S)
            if isinstance(event, Joined):
                _log(f"{event.name} is here")
            elif isinstance(event, Left):
                _log(f"{event.name} has left")
    return interrupts.code or Exit.DONE


def _log(line: str) -> None:
    print(line, flush=True)
