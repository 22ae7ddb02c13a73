"""What `kantor compose` writes, and refuses; no engine is needed."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from kantor_fleet.processes.compose import ComposeConfig, text

if TYPE_CHECKING:
    from support.processes.command import Kantor

ROOT = Path(__file__).parents[2]


def read(order: ComposeConfig) -> dict[str, Any]:
    tree = yaml.safe_load(text(order))
    assert isinstance(tree, dict)
    return tree


def test_the_file_of_the_repository_is_what_the_command_writes(kantor: "Kantor") -> None:
    """Byte for byte."""
    done = kantor("compose", "--robots", 5, "--supervisor", "--out", "compose.yaml")

    assert done.code == 0, done.err
    written = (kantor.folder / "compose.yaml").read_text()
    assert written == (ROOT / "docker" / "compose.yaml").read_text()
    assert (kantor.folder / "runs").is_dir()
    assert "KANTOR_USER=" in (kantor.folder / ".env").read_text()


@pytest.mark.parametrize(
    "order", [ComposeConfig(5), ComposeConfig(8, isolated=True), ComposeConfig(3, supervisor=True)]
)
def test_each_service_has_an_identity_and_no_privilege(order: ComposeConfig) -> None:
    """A secret of its own, a read-only root, no capability, limits."""
    tree = read(order)
    people = {f"r{i}" for i in range(1, order.robots + 1)} | (
        {"supervisor"} if order.supervisor else set()
    )

    assert tree["services"].pop("keys")["network_mode"] == "none"
    assert set(tree["services"]) == people | {"worldsim"} == set(tree["secrets"])
    for name, service in tree["services"].items():
        assert [secret["source"] for secret in service["secrets"]] == [name]
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert {"cpus", "mem_limit", "pids_limit"} <= set(service)
        assert not {"ports", "privileged", "cap_add"} & set(service)


def test_isolated_robots_share_no_network() -> None:
    """Each has one with world-sim, which is in all."""
    services = read(ComposeConfig(8, isolated=True))["services"]
    networks = [tuple(services[f"r{i}"]["networks"]) for i in range(1, 9)]

    assert len(set(networks)) == 8
    assert set(services["worldsim"]["networks"]) == {network for (network,) in networks}


def test_a_hub_elsewhere_leaves_the_robots_alone_in_the_file() -> None:
    """They connect to it, and are healthy by its port."""
    tree = read(ComposeConfig(2, hub="tls/hub.example.org:17447"))

    assert set(tree["services"]) == {"r1", "r2"} == set(tree["secrets"])
    for service in tree["services"].values():
        assert "tls/hub.example.org:17447" in service["command"]
        assert service["environment"]["KANTOR_PORT"] == 17447
        assert "depends_on" not in service


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--robots", 0), "--robots 0: give 1 to"),
        (("--robots", 40, "--isolated"), "--isolated: a network for each robot"),
        (("--robots", 8), "starts"),
        (("--scenario", "paper-centralized"), "add --supervisor"),
        (("--scenario", "nowhere"), "no packaged scenario"),
    ],
)
def test_impossible_options_are_refused_in_a_line(
    kantor: "Kantor", arguments: tuple[object, ...], line: str
) -> None:
    """With the remedy, before anything is written."""
    done = kantor("compose", *arguments)

    assert done.code == 2
    assert line in done.err
    assert len(done.err.splitlines()) == 1
    assert not (kantor.folder / "compose.yaml").exists()
