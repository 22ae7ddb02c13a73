"""Identity files: what is written is read again, and only members in the list are admitted."""

import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.transport import credentials
from kantor_protocol.transport.credentials import Certificate, CredentialsError, Member, Password
from kantor_protocol.wire.signatures import is_signed
from support.strategies import examples

NOW = datetime(2026, 11, 23, tzinfo=UTC)
USERS = ("r1", "r2", "r3", "observer", "supervisor")
times = st.datetimes(timezones=st.just(UTC)).map(lambda time: time.replace(microsecond=0))
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=40)
hexes = st.sampled_from(["", "01" * 33, "02" * 34])
serials = st.integers(0, 2**64 - 1)


def name_of(user: str, serial: int) -> str:
    """A certificate's name."""
    return f"{user}.{serial:016x}"


@st.composite
def routers(draw: st.DrawFn) -> Certificate:
    """World-sim's identity with some register; parts are texts of any kind."""
    users = draw(st.lists(st.sampled_from(USERS), unique=True))
    members = {
        user: Member(name_of(user, draw(serials)), draw(times), draw(hexes)) for user in users
    }
    gone = draw(st.lists(st.builds(name_of, st.sampled_from(USERS), serials), max_size=3))
    sites = draw(
        st.dictionaries(
            st.sampled_from(("site-north", "site-south")),
            st.lists(st.sampled_from(USERS)).map(tuple),
        )
    )
    return Certificate(
        "demo", "worldsim", name_of("worldsim", 7), draw(times), draw(texts), draw(texts), draw(texts),
        tuple(name for name in gone if name not in {member.name for member in members.values()}),
        members, sites,
    )  # fmt: skip


def written(identity: credentials.Identity, path: Path) -> credentials.Identity:
    """An identity from its file."""
    tree = msgspec.to_builtins(identity, builtin_types=(datetime,))
    credentials.write(path, credentials.to_toml(tree))
    return credentials.find(path, identity.user)


@given(routers())
@examples(200)
def test_what_is_written_is_read_again(
    tmp_path_factory: pytest.TempPathFactory, router: Certificate
) -> None:
    """Any text, any time, any register."""
    path = tmp_path_factory.getbasetemp() / "worldsim.toml"
    assert written(router, path) == router
    assert path.stat().st_mode & 0o777 == 0o600


@given(st.dictionaries(texts.filter(str.isidentifier), st.one_of(texts, times, st.lists(texts))))
@examples(300)
def test_toml_is_what_python_reads(tree: dict[str, object]) -> None:
    flat = {key: value for key, value in tree.items() if key.isascii()}
    assert tomllib.loads(credentials.to_toml(flat)) == flat


@given(
    routers(),
    st.builds(name_of, st.sampled_from((*USERS, "r9")), serials),
    st.sets(st.sampled_from(USERS)),
)
@examples(200)
def test_only_whom_the_register_names_is_let_in(
    router: Certificate, name: str, wanted: set[str]
) -> None:
    """By its very certificate, and only if it takes part; else there is an objection of one line."""
    for shown in (name, *router.revoked, *(member.name for member in router.members.values())):
        objection = router.refusal_reason(shown, wanted)
        named = [
            user for user in wanted if user in router.members and router.members[user].name == shown
        ]
        assert bool(objection) == (not named)
        assert "\n" not in objection


@given(routers())
@examples(100)
def test_a_site_does_not_speak_for_who_is_revoked(router: Certificate) -> None:
    behind = router.robots_by_site()
    assert set(behind) == set(router.sites)
    for site, there in behind.items():
        assert set(there) == set(router.sites[site]) & set(router.members)


def test_a_warning_comes_a_week_ahead() -> None:
    members = {
        "worldsim": Member(name_of("worldsim", 7), NOW + timedelta(days=8)),
        "r1": Member(name_of("r1", 1), NOW + timedelta(days=7)),
        "r2": Member(name_of("r2", 1), NOW + timedelta(days=6, hours=23)),
        "r3": Member(name_of("r3", 1), NOW),
    }
    router = Certificate("demo", "worldsim", name_of("worldsim", 7), NOW, "", "", "", (), members)

    assert router.warnings(("r1", "r2", "r3", "r4"), NOW) == [
        "r2's certificate expires on 2026-11-29 23:00 UTC; `kantor keys demo --renew r2`",
        "r3's certificate expired on 2026-11-23 00:00 UTC; `kantor keys demo --renew r3`",
    ]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("fleet", "a/**"),
        ("name", "r2.0123456789abcdef"),
        ("name", "r1.*"),
        ("name", "r1.0123456789abcdef/x"),
        ("until", datetime(2027, 1, 1)),  # noqa: DTZ001  without its zone
        ("key", "x" * 20_000),
        ("user", ""),
    ],
)
def test_no_authority_has_made_this(tmp_path: Path, field: str, value: object) -> None:
    sound = Certificate("demo", "r1", "r1.0123456789abcdef", NOW, "a", "b", "c")
    tree = msgspec.to_builtins(sound, builtin_types=(datetime,)) | {field: value}
    path = tmp_path / "r1.toml"
    credentials.write(path, credentials.to_toml(tree))

    with pytest.raises(CredentialsError, match="not a credentials file"):
        credentials.find(path, "r1")


def test_passwords_overwrite_nothing(tmp_path: Path) -> None:
    """Passwords of the fleet are kept; a certificate, another fleet's file or a damaged one is left alone."""
    first = credentials.issue(tmp_path, "demo", ("r1",))
    assert credentials.issue(tmp_path, "demo", ("r1", "r2"))["r1"] == first["r1"]
    sound = Certificate("demo", "r3", "r3.0123456789abcdef", NOW, "a", "b", "c")
    for content, complaint in (
        (
            credentials.to_toml(msgspec.to_builtins(sound, builtin_types=(datetime,))),
            "a certificate; listen on tls",
        ),
        (credentials.to_toml(msgspec.to_builtins(Password("other", "r3", "x"))), "of fleet other"),
        ("not = [a file", "not a credentials file; delete it"),
    ):
        (tmp_path / "r3.toml").write_text(content)
        before = {path: path.read_bytes() for path in tmp_path.iterdir()}
        with pytest.raises(CredentialsError, match=complaint):
            credentials.issue(tmp_path, "demo", ("r1", "r2", "r3", "r4"))
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_every_password_has_a_key_of_its_own() -> None:
    """It follows from the password, and is another for each fleet and user, even with the same password."""
    one = Password("demo", "r1", "secret")
    others = [
        Password("demo", "r1", "Secret"),
        Password("demo", "r2", "secret"),
        Password("de", "r1", "secret"),
    ]
    keys = [credentials.public_key(each) for each in (one, *others)]

    assert len(set(keys)) == 4
    assert credentials.public_key(one) == keys[0]
    assert is_signed(keys[0], b"word", credentials.signing_key(one).sign(b"word"))
    assert not is_signed(keys[1], b"word", credentials.signing_key(one).sign(b"word"))


def test_a_certificate_without_its_key_cannot_sign() -> None:
    """One line with the remedy."""
    for text in ("", "c", "-----BEGIN PRIVATE KEY-----"):
        broken = Certificate("demo", "r1", "r1.0123456789abcdef", NOW, "a", "b", text)
        with pytest.raises(CredentialsError, match="`kantor keys demo --renew r1` makes another"):
            credentials.signing_key(broken)


@pytest.mark.parametrize("key", ["0", "0g", "0A", "01" * 35, " "])
def test_a_member_list_has_keys_or_nothing(key: str) -> None:
    """Whole bytes, hexadecimal, no longer than any key."""
    with pytest.raises(ValueError, match="public key"):
        Member("r1.0123456789abcdef", NOW, key)
