"""Reasons why a connection with certificates is refused, in plain English.

Zenoh reports them to neither side. A client therefore makes one TLS handshake by itself before it joins, with the
same certificate and the same authority, and reads the alert; world-sim reads the line that Zenoh logs.
"""

import os
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from kantor_protocol.transport.credentials import Certificate, CredentialsError

if TYPE_CHECKING:
    import ssl

HANDSHAKE_S = 5.0
_WINDOW_S = 10.0
"""World-sim reports the same reason once in this time, however many clients are refused."""


def handshake_failure(host: str, port: int, identity: Certificate) -> str:
    """Make a TLS handshake with a router: why it fails, with the remedy; empty if it succeeds.

    Raises OSError if nothing listens there, CredentialsError if the identity is damaged.
    """
    import ssl  # noqa: PLC0415  2 MB that robots with passwords do without

    renew = f"`kantor keys {identity.fleet} --renew {identity.user}` makes a new one"
    with socket.create_connection((host, port), timeout=HANDSHAKE_S) as raw:
        try:
            _shake_hands(raw, host, context(identity))
        except ssl.SSLCertVerificationError as error:
            return _distrust(error, host, identity)
        except ssl.SSLError as error:
            reason = (error.reason or "").lower()
            for pattern, words in _ALERTS.items():
                if re.search(pattern, reason):
                    return words.format(user=identity.user, renew=renew)
            return f"the handshake failed ({error.reason or 'no answer'}); is it a world-sim with certificates?"
        except OSError:
            return "does not answer as one with certificates; check --connect"
    return ""


_ALERTS = {
    "certificate_expired": "refuses {user}: its certificate has expired; {renew}",
    "unknown_ca|decrypt_error": "refuses {user}: its certificate is from another authority; "
    "use the file that this fleet's `kantor keys` has made",
    "certificate_required|handshake_failure": "refuses {user}: it showed no certificate; {renew}",
    "bad_certificate|certificate_unknown|unsupported_certificate": "refuses {user}: its certificate is no use; {renew}",
    "wrong_version_number|record_layer|unexpected_eof|http_request": "does not answer as one with certificates; "
    "check --connect",
}
"""OpenSSL's names of alerts, and what they mean."""


def _shake_hands(raw: socket.socket, host: str, context: "ssl.SSLContext") -> None:
    """Make a handshake, and wait for the server's verdict. Raises ssl.SSLError, OSError."""
    with context.wrap_socket(raw, server_hostname=host) as secured:
        # In TLS 1.3 the server examines the client's certificate after the client's handshake is over. Once it has
        # received the end of the client's data, it has either sent its alert or closes.
        raw_end = socket.socket(fileno=os.dup(secured.fileno()))
        with raw_end, suppress(OSError):  # it may be closed already
            raw_end.shutdown(socket.SHUT_WR)
        with suppress(
            ConnectionError
        ):  # without an alert: the router answers why, see RefusalResponder
            secured.recv(1)


def _distrust(error: "ssl.SSLCertVerificationError", host: str, identity: Certificate) -> str:
    """Why this identity does not trust the server that answers."""
    code, fleet = error.verify_code, identity.fleet
    if code in {62, 64}:  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH
        return (
            f"what answers has no certificate for the name {host}; connect by another name, "
            f"or `kantor keys {fleet} --host {host}` and start world-sim with it"
        )
    if code in {9, 10}:  # X509_V_ERR_CERT_NOT_YET_VALID, X509_V_ERR_CERT_HAS_EXPIRED
        return (
            f"world-sim's certificate is {'not valid yet' if code == 9 else 'expired'}; "
            f"check the clock, or `kantor keys {fleet} --renew worldsim` and start world-sim with it"
        )
    if code == 26:  # X509_V_ERR_INVALID_PURPOSE
        return "what answers shows a robot's certificate, not world-sim's; do not trust it"
    return (
        f"what answers has a certificate from another authority ({error.verify_message}); "
        f"it is not the world-sim of this identity's fleet {fleet}"
    )


def context(identity: Certificate) -> "ssl.SSLContext":
    """The SSL context of a client, which trusts the fleet's authority alone. Raises CredentialsError."""
    import ssl  # noqa: PLC0415

    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        made.load_verify_locations(cadata=identity.authority)
        with _readable(identity.certificate) as certificate, _readable(identity.key) as key:
            made.load_cert_chain(certificate, key, password=lambda: "")
    except (ssl.SSLError, ValueError):
        raise CredentialsError(
            f"{identity.user}.toml: its certificate or key is damaged; "
            f"`kantor keys {identity.fleet} --renew {identity.user}` makes a new one"
        ) from None
    return made


@contextmanager
def _readable(text: str) -> Iterator[str]:
    """A path from which a text can be read, for a library that reads files only; no file is made."""
    reading, writing = os.pipe()
    try:
        with os.fdopen(writing, "w", encoding="utf-8") as file:
            file.write(text)
        yield f"/dev/fd/{reading}"
    finally:
        os.close(reading)


class RefusalLog:
    """Reports refused clients: a line for each reason at once, then, now and then, how often it occurred."""

    def __init__(
        self, notify: Callable[[str], None], monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        """notify: takes one line for the operator. monotonic: seconds."""
        self._notify = notify
        self._monotonic = monotonic
        self._due_s: dict[str, float] = {}
        self._unreported: dict[str, int] = {}

    def report(self, reason: str) -> None:
        """Count a refused client, and report the reason if that is due."""
        now_s = self._monotonic()
        self._unreported[reason] = self._unreported.get(reason, 0) + 1
        if now_s >= self._due_s.get(reason, now_s):
            self._due_s[reason] = now_s + _WINDOW_S
            self._flush(reason)

    def close(self) -> None:
        """Report what has not been reported yet."""
        for reason in tuple(self._unreported):
            self._flush(reason)

    def _flush(self, reason: str) -> None:
        count = self._unreported.pop(reason)
        self._notify(reason if count == 1 else f"{reason} ({count} times)")


_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_LOGGED = re.compile(r" WARN .*zenoh_link_tls::unicast: (.*?)(?:\. Hint: .*)?$")
_LOGGED_REASONS = {
    "certificate expired": "its certificate has expired",
    "UnknownIssuer|BadSignature": "its certificate is from another authority",
    "peer sent no certificates": "it showed no certificate",
    "InvalidContentType|corrupt message": "it does not speak TLS",
    "fatal alert: (UnknownCA|DecryptError)": "it trusts another authority than world-sim's",
    "fatal alert: CertificateExpired": "to it, world-sim's certificate has expired",
    "fatal alert: (UnsupportedCertificate|BadCertificate|CertificateUnknown)": "it does not trust world-sim's certificate",
}
_PROBE = re.compile(r"\beof\b|reset|timed? ?out", re.IGNORECASE)
"""A connection that only probes whether the port is open is not a refused client."""


def logged_reason(line: str) -> str:
    """Why Zenoh refused a client, from a line of its log; empty if the line is about something else."""
    found = _LOGGED.search(_COLOURS.sub("", line).rstrip())
    if found is None or _PROBE.search(found[1]):
        return ""
    for pattern, words in _LOGGED_REASONS.items():
        if re.search(pattern, found[1]):
            return f"refused a client: {words}"
    return f"refused a client: {found[1][:200]}"
