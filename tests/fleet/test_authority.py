"""A fleet's authority: the certificates that it issues, its member list, and the requests that it refuses."""

import re
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.security import authority as issuing
from kantor_fleet.security.authority import Authority, Wanted, issue, listing
from kantor_protocol.transport import credentials
from kantor_protocol.transport.credentials import Certificate, CredentialsError
from kantor_protocol.wire.signing_keys import public_key_of
from support.strategies import examples

if TYPE_CHECKING:
    from support.processes.command import Kantor

NOW = datetime(2026, 11, 23, 12, tzinfo=UTC)


def identity(folder: Path, user: str) -> Certificate:
    """The identity of a member in a folder."""
    found = credentials.find(folder, user)
    assert isinstance(found, Certificate)
    return found


def authority_in(folder: Path) -> Authority:
    """The authority of a folder."""
    found = credentials.read(folder / "authority.toml", Authority)
    assert found is not None
    return found


def contents(folder: Path) -> dict[Path, bytes]:
    """All the files below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def certificate_of(found: Certificate) -> x509.Certificate:
    return x509.load_pem_x509_certificate(found.certificate.encode())


def purposes(certificate: x509.Certificate) -> set[str]:
    usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    return {purpose.dotted_string for purpose in usage}


def test_every_member_gets_one_file(tmp_path: Path) -> None:
    """For its owner alone; the authority's key is in none of them; only routers can serve."""
    folder = tmp_path / "keys"
    issue(
        folder, Wanted("demo", 2, supervisor=True, hosts=("hub.example", "10.0.0.7"), days=30), NOW
    )

    users = ["observer", "r1", "r2", "supervisor", "worldsim"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{name}.toml" for name in ("authority", *users)
    )
    assert folder.stat().st_mode & 0o777 == 0o700
    own = authority_in(folder)
    root = x509.load_pem_x509_certificate(own.certificate.encode())
    for user in users:
        found = identity(folder, user)
        certificate = certificate_of(found)
        certificate.verify_directly_issued_by(root)
        key = serialization.load_pem_private_key(found.key.encode(), None)
        assert key.public_key() == certificate.public_key()
        assert (
            certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == found.name
        )
        assert own.members[user].key == credentials.public_key(found).hex()
        assert public_key_of(certificate.public_key()).hex() == own.members[user].key  # type: ignore[arg-type]
        assert found.name == f"{user}.{certificate.serial_number:016x}"
        assert found.until == certificate.not_valid_after_utc == NOW + timedelta(days=30)
        assert own.members[user].name == found.name
        assert own.key.strip() not in (folder / f"{user}.toml").read_text()
        serves = ExtendedKeyUsageOID.SERVER_AUTH.dotted_string in purposes(certificate)
        assert serves == (user == "worldsim")
        assert (folder / f"{user}.toml").stat().st_mode & 0o777 == 0o600
    names = certificate_of(identity(folder, "worldsim")).extensions.get_extension_for_class(
        x509.SubjectAlternativeName
    )
    assert names.value.get_values_for_type(x509.DNSName) == ["localhost", "worldsim", "hub.example"]
    assert [str(name) for name in names.value.get_values_for_type(x509.IPAddress)] == [
        "127.0.0.1", "::1", "10.0.0.7",
    ]  # fmt: skip
    assert identity(folder, "worldsim").members == own.members
    assert identity(folder, "r1").members == {}


def test_a_second_command_keeps_members_and_adds_missing_ones(tmp_path: Path) -> None:
    """Also what was handed out; world-sim's copy follows."""
    issue(tmp_path, Wanted("demo", 2), NOW)
    (tmp_path / "r1.toml").unlink()  # it is with its robot
    before = contents(tmp_path)

    assert issue(tmp_path, Wanted("demo", 2), NOW) == ["nothing to do"]
    assert contents(tmp_path) == before
    lines = issue(tmp_path, Wanted("demo", 3), NOW)

    after = contents(tmp_path)
    changed = {path.name for path in after if after[path] != before.get(path)}
    assert changed == {"r3.toml", "authority.toml", "worldsim.toml"}
    assert [line.partition(":")[0].rpartition("/")[2] for line in lines] == [
        "r3.toml",
        "worldsim.toml",
    ]
    assert set(identity(tmp_path, "worldsim").members) == {"observer", "worldsim", "r1", "r2", "r3"}


def test_a_member_list_without_keys_is_completed(tmp_path: Path) -> None:
    """Of an older version: from the files that are there; a member whose file is elsewhere gets a key by renewal."""
    issue(tmp_path, Wanted("demo", 2), NOW)
    full = authority_in(tmp_path).members
    for name in ("authority", "worldsim"):
        path = tmp_path / f"{name}.toml"
        path.write_text(re.sub(r', key = "[0-9a-f]+"', "", path.read_text()))
    (tmp_path / "r2.toml").unlink()  # it is with its robot
    assert not any(member.key for member in identity(tmp_path, "worldsim").members.values())

    assert issue(tmp_path, Wanted("demo"), NOW) == [
        f"{tmp_path}/worldsim.toml: changed; start worldsim again with it"
    ]
    keys = {user: member.key for user, member in identity(tmp_path, "worldsim").members.items()}
    assert keys == {user: member.key for user, member in full.items()} | {"r2": ""}
    assert issue(tmp_path, Wanted("demo"), NOW) == ["nothing to do"]

    issue(tmp_path, Wanted("demo", renew=("r2",)), NOW)
    (listed,) = identity(tmp_path, "worldsim").public_keys(("r2",)).values()
    assert listed == credentials.public_key(identity(tmp_path, "r2"))


def test_renewal_and_revocation_invalidate_the_old_certificate(tmp_path: Path) -> None:
    """Renewed: the old one becomes invalid. Revoked: it stays so until its name is renewed."""
    issue(tmp_path, Wanted("demo", 3), NOW)
    old = {name: identity(tmp_path, name).name for name in ("r1", "r2", "r3")}

    issue(tmp_path, Wanted("demo", renew=("r1",), revoke=("r2",)), NOW)
    router, team = identity(tmp_path, "worldsim"), ("r1", "r2", "r3")
    assert router.refusal_reason(identity(tmp_path, "r1").name, team) == ""
    assert "use the newest r1.toml" in router.refusal_reason(old["r1"], team)
    assert "has been revoked" in router.refusal_reason(old["r2"], team)
    assert router.refusal_reason(old["r3"], team) == ""

    issue(tmp_path, Wanted("demo", 3), NOW)
    assert "r2" not in authority_in(tmp_path).members
    issue(tmp_path, Wanted("demo", renew=("r2",)), NOW)
    router = identity(tmp_path, "worldsim")
    assert router.refusal_reason(identity(tmp_path, "r2").name, team) == ""
    assert "has been revoked" in router.refusal_reason(old["r2"], team)


def test_sites_carry_member_lists_of_their_own(tmp_path: Path) -> None:
    """Their robots and world-sim; it follows what becomes of these; each has names of its own."""
    issue(
        tmp_path,
        Wanted("demo", 4, sites=("north=r1,r2", "south=r3"), hosts=("north=10.0.0.5",)),
        NOW,
    )
    north = identity(tmp_path, "site-north")
    assert set(north.members) == {"worldsim", "r1", "r2"}
    assert identity(tmp_path, "worldsim").sites == {
        "site-north": ("r1", "r2"),
        "site-south": ("r3",),
    }
    alternative = certificate_of(north).extensions.get_extension_for_class(
        x509.SubjectAlternativeName
    )
    assert [str(name) for name in alternative.value.get_values_for_type(x509.IPAddress)] == [
        "127.0.0.1", "::1", "10.0.0.5",
    ]  # fmt: skip
    assert alternative.value.get_values_for_type(x509.DNSName) == ["localhost", "site-north"]

    (tmp_path / "site-south.toml").unlink()  # handed out
    lines = issue(tmp_path, Wanted("demo", revoke=("r2",)), NOW)
    assert set(identity(tmp_path, "site-north").members) == {"worldsim", "r1"}
    assert identity(tmp_path, "worldsim").robots_by_site()["site-north"] == ("r1",)
    assert [line.partition(":")[0].rpartition("/")[2] for line in lines] == [
        "r2", "worldsim.toml", "site-north.toml",
    ]  # fmt: skip
    with pytest.raises(
        CredentialsError, match=r"site-south.toml: missing or not usable, .* --renew site-south"
    ):
        issue(tmp_path, Wanted("demo", sites=("south=r1,r3",)), NOW)
    issue(tmp_path, Wanted("demo", sites=("south=r1,r3",), renew=("site-south",)), NOW)
    assert set(identity(tmp_path, "site-south").members) == {"worldsim", "r1", "r3"}
    assert set(identity(tmp_path, "site-north").members) == {"worldsim"}


@pytest.mark.parametrize(
    ("wanted", "complaint"),
    [
        (Wanted("Demo"), "Demo: use lower-case letters"),
        (Wanted("demo", -1), "--robots -1: give a number"),
        (Wanted("demo", 10**9), "--robots 1000000000: give a number"),
        (Wanted("demo", days=0), "--days 0: give a number"),
        (
            Wanted("demo", hosts=("hub:7447",)),
            "--host hub:7447: give a name or an IP address, without a port",
        ),
        (Wanted("demo", hosts=("",)), "--host : give a name"),
        (Wanted("demo", hosts=("east=hub",)), "--host east=hub: no such site"),
        (Wanted("demo", sites=("north",)), "--site north: write it as"),
        (Wanted("demo", sites=("north=r1,r0",)), "--site north=r1,r0: write it as"),
        (
            Wanted("demo", sites=("north=r9",)),
            "--site north: the register has no r9; add --robots 9",
        ),
        (Wanted("demo", sites=("north=r1", "south=r1")), "r1 can be behind one site only"),
        (Wanted("demo", renew=("r9",)), "--renew r9: is not in the register"),
        (Wanted("demo", renew=("../r1",)), "--renew ../r1: is not in the register"),
        (Wanted("demo", renew=("site-x",)), "--renew site-x: no such site"),
        (Wanted("demo", revoke=("r9",)), "--revoke r9: is not in the register"),
        (Wanted("demo", revoke=("r2",)), "--revoke r2: is revoked already"),
        (Wanted("demo", revoke=("worldsim",)), "--revoke worldsim: robots know no register"),
        (Wanted("demo", renew=("r1",), revoke=("r1",)), "--renew r1 --revoke r1"),
        (Wanted("other", 2), "the authority of fleet demo; choose another --out"),
    ],
)
def test_a_refused_request_changes_nothing(tmp_path: Path, wanted: Wanted, complaint: str) -> None:
    issue(tmp_path, Wanted("demo", 2), NOW)
    issue(tmp_path, Wanted("demo", revoke=("r2",)), NOW)
    before = contents(tmp_path)

    with pytest.raises(CredentialsError, match=re.escape(complaint)) as caught:
        issue(tmp_path, wanted, NOW)

    assert "\n" not in str(caught.value)
    assert contents(tmp_path) == before


def test_files_that_are_not_the_authoritys_are_left_alone(tmp_path: Path) -> None:
    """A folder of passwords, a damaged authority, a lost identity of world-sim."""
    credentials.issue(tmp_path / "passwords", "demo", ("r1",))
    issue(tmp_path / "damaged", Wanted("demo", 1), NOW)
    (tmp_path / "damaged" / "authority.toml").write_text("fleet = 1")
    issue(tmp_path / "lost", Wanted("demo", 1), NOW)
    (tmp_path / "lost" / "worldsim.toml").unlink()
    before = contents(tmp_path)

    for name, complaint in (
        ("passwords", "has observer.toml, but no authority.toml; choose an empty folder"),
        ("damaged", "not an authority, or damaged"),
        ("lost", "--renew worldsim"),
    ):
        with pytest.raises(CredentialsError, match=complaint):
            issue(tmp_path / name, Wanted("demo", 2), NOW)
    assert contents(tmp_path) == before
    issue(tmp_path / "lost", Wanted("demo", 2, renew=("worldsim",)), NOW)
    assert set(identity(tmp_path / "lost", "worldsim").members) == {
        "observer",
        "worldsim",
        "r1",
        "r2",
    }


@pytest.mark.parametrize(
    "wanted", [Wanted("demo", 3), Wanted("demo", 2, renew=("r1",), revoke=("r2",))]
)
def test_an_interrupted_request_is_completed_by_running_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: Wanted
) -> None:
    """The disk is full at the n-th file: what there is is whole, and the next run ends where this would have."""
    for n in range(10):
        folder = tmp_path / str(n)
        issue(folder, Wanted("demo", 2), NOW)
        left = iter(range(n))

        def write(path: Path, text: str, left: "iter[int]" = left) -> None:  # type: ignore[valid-type]
            if next(left, None) is None:
                raise OSError(28, "No space left on device", str(path))
            credentials.write(path, text)

        with monkeypatch.context() as patched:
            patched.setattr(issuing, "write", write)
            try:
                issue(folder, wanted, NOW)
            except OSError:
                done = False
            else:
                done = True
        if not done:
            revoked = (
                "r2" not in authority_in(folder).members
            )  # then that is done, and refused a second time
            again = Wanted(
                "demo", wanted.robots, renew=wanted.renew, revoke=() if revoked else wanted.revoke
            )
            issue(folder, again, NOW)
        own, router = authority_in(folder), identity(folder, "worldsim")
        assert router.members == own.members
        assert router.revoked == own.revoked
        for user, member in own.members.items():
            assert identity(folder, user).name == member.name
        assert ("r2" in own.members) == (not wanted.revoke)
    assert done


@given(
    st.lists(
        st.one_of(
            st.builds(lambda count: Wanted("demo", count), st.integers(0, 4)),
            st.builds(
                lambda user: Wanted("demo", renew=(user,)),
                st.sampled_from(("r1", "r2", "worldsim")),
            ),
            st.builds(
                lambda user: Wanted("demo", revoke=(user,)),
                st.sampled_from(("r1", "r2", "observer", "site-a")),
            ),
            st.builds(
                lambda text: Wanted("demo", sites=(text,)),
                st.sampled_from(("a=r1", "a=r2", "b=r1,r2")),
            ),
        ),
        max_size=6,
    )
)
@examples(20)
def test_the_member_list_has_one_valid_certificate_for_each(
    tmp_path_factory: pytest.TempPathFactory, requests: list[Wanted]
) -> None:
    """After any requests, refused ones too: files, member list and routers' copies agree; no member has two."""
    folder, ever = tmp_path_factory.mktemp("keys"), set()
    for wanted in (Wanted("demo", 1), *requests):
        with suppress(CredentialsError):
            issue(folder, wanted, NOW)
        own = authority_in(folder)
        ever |= {member.name for member in own.members.values()}
        router = identity(folder, "worldsim")
        assert (router.members, router.sites, router.revoked) == (
            own.members,
            own.sites,
            own.revoked,
        )
        assert all(
            identity(folder, user).name == member.name for user, member in own.members.items()
        )
        counts = {name for name in ever if not router.refusal_reason(name, own.members)}
        assert counts == {member.name for member in own.members.values()}
        placed = [name for there in own.sites.values() for name in there]
        assert len(set(placed)) == len(placed)
        for site, there in own.sites.items():
            if site in own.members:
                known = {"worldsim", *there} & set(own.members)
                assert set(identity(folder, site).members) == known


def test_the_listing_has_members_and_expiry(kantor: "Kantor") -> None:
    assert kantor("keys", "demo", "--list").code == 2
    made = kantor("keys", "demo", "--robots", 2, "--days", 10)
    assert (made.code, made.err) == (0, "")
    assert (
        made.out.splitlines()[0] == "keys/authority.toml: the authority of fleet demo; keep it here"
    )
    assert kantor("keys", "demo", "--revoke", "r2").out == (
        "r2: revoked\nkeys/worldsim.toml: changed; start worldsim again with it\n"
    )
    again = kantor("keys", "demo", "--revoke", "r2")
    assert (again.code, again.err) == (
        2, "kantor: --revoke r2: is revoked already; see `kantor keys demo --list`\n",
    )  # fmt: skip
    listed = kantor("keys", "demo", "--list").out.splitlines()
    assert [line.split()[0] for line in listed] == ["observer", "worldsim", "r1", "r2"]
    assert all(re.search(r"expires on \d{4}-\d\d-\d\d \d\d:\d\d UTC$", line) for line in listed[:3])
    assert listed[3].endswith("revoked")
    blocked = kantor.folder / "file"
    blocked.write_text("")
    assert kantor("keys", "demo", "--out", blocked).code == 2


def test_a_certificate_lasts_no_longer_than_its_authority(tmp_path: Path) -> None:
    issue(tmp_path, Wanted("demo", 1), NOW)
    late = NOW + timedelta(days=7290)
    issue(tmp_path, Wanted("demo", renew=("r1",)), late)
    assert identity(tmp_path, "r1").until == NOW + timedelta(days=7300)
    with pytest.raises(CredentialsError, match=r"authority.toml: has expired"):
        issue(tmp_path, Wanted("demo", renew=("r1",)), late + timedelta(days=10))
    assert any("expired" in line for line in listing(tmp_path, "demo", late))
