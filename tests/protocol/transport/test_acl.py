"""Who may do what on a router: rules about the rules."""

from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.transport import acl
from kantor_protocol.wire import keys
from support.strategies import examples

FLEET = "f"
ROSTER = ("r1", "r2", "r3", "r10", "supervisor")
some_members = st.lists(st.sampled_from(ROSTER), unique=True, min_size=1)


def names_in(grants: acl.Grants) -> set[str]:
    """Whose keys a subject may use, but for knowing who subscribes."""
    uses = [grant for grant in grants if (grant.flow, grant.message) != HEARS_OF]
    parsed = [keys.parse(key) for grant in uses for key in grant.keys]
    return {key.name for key in parsed if key is not None}


HEARS_OF = ("egress", "declare_subscriber")


@given(some_members)
@examples(50)
def test_a_site_may_do_what_its_robots_may(members: list[str]) -> None:
    """No key of anybody else, and none that its robots cannot use themselves."""
    of_robots = {
        (grant.flow, grant.message, key)
        for name in members
        for grant in acl.robot(FLEET, name)
        for key in grant.keys
    }
    of_site = {
        (grant.flow, grant.message, key) for grant in acl.site(FLEET, members) for key in grant.keys
    }

    assert of_site == of_robots
    assert names_in(acl.site(FLEET, members)) == set(members)


@given(some_members)
@examples(20)
def test_what_one_end_of_a_link_lets_out_the_other_lets_in(members: list[str]) -> None:
    """The hub's rules about a site and the site's about the hub are mirror images."""
    site, hub = acl.site(FLEET, members), acl.hub(FLEET, members)

    assert [grant.mirrored for grant in hub] == list(site)
    assert {(grant.message, grant.keys) for grant in hub} == {
        (grant.message, grant.keys) for grant in site
    }
    assert all(one.flow != other.flow for one, other in zip(site, hub, strict=True))


def test_everything_else_is_denied() -> None:
    """Rules have ids of their own, and every rule has a subject."""
    control = acl.control(
        [(name, {"usernames": [name]}, acl.robot(FLEET, name)) for name in ROSTER]
    )

    labels = [rule["id"] for rule in control["rules"]]
    assert control["default_permission"] == "deny"
    assert {rule["permission"] for rule in control["rules"]} == {"allow"}
    assert len(set(labels)) == len(labels)
    assert sorted(label for policy in control["policies"] for label in policy["rules"]) == sorted(
        labels
    )
    assert [subject["id"] for subject in control["subjects"]] == list(ROSTER)
