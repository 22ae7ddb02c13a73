"""Reasons in words: what Zenoh logs, told once and not a thousand times."""

import pytest

from kantor_protocol.transport.tls import RefusalLog, logged_reason

START = "\x1b[2m2026-11-23T01:03:57.322606Z\x1b[0m \x1b[33m WARN\x1b[0m acc-0 ThreadId(04) "
START += "\x1b[2mzenoh_link_tls::unicast\x1b[0m\x1b[2m:\x1b[0m "
HINT = ". Hint: increase the system open file limit.\n"


@pytest.mark.parametrize(
    ("logged", "reason"),
    [
        ("peer sent no certificates", "it showed no certificate"),
        ("invalid peer certificate: UnknownIssuer", "its certificate is from another authority"),
        (
            (
                "invalid peer certificate: certificate expired: verification time 1795395843 (UNIX), but "
                "certificate is not valid after 1795392236 (3607 seconds ago)"
            ),
            "its certificate has expired",
        ),
        ("received corrupt message of type InvalidContentType", "it does not speak TLS"),
        ("received fatal alert: UnknownCA", "it trusts another authority than world-sim's"),
        ("received fatal alert: Whatever", "received fatal alert: Whatever"),
    ],
)
def test_a_line_of_zenoh_says_why(logged: str, reason: str) -> None:
    assert logged_reason(START + logged + HINT) == f"refused a client: {reason}"


@pytest.mark.parametrize(
    "line", ["", "\n", "kantor: x", START + "tls handshake eof" + HINT, "\x1b[2m"]
)
def test_other_lines_say_nothing(line: str) -> None:
    """Who only looks whether the port is open is not refused."""
    assert logged_reason(line) == ""


def test_a_thousand_refusals_are_a_few_lines() -> None:
    """At once, then at most every ten seconds for each reason, with how many; none is forgotten."""
    said: list[str] = []
    times = iter([i * 0.025 for i in range(1000)])  # 25 s
    refusals = RefusalLog(said.append, lambda: next(times))
    for i in range(1000):
        refusals.report("odd" if i % 2 else "even")
    refusals.close()

    assert said[:2] == ["even", "odd"]
    assert len(said) == 8
    for reason in ("even", "odd"):
        counts = [text.removeprefix(reason) for text in said if text.startswith(reason)]
        assert sum(int(text.strip(" ()times") or 1) for text in counts) == 500
