"""The systemd units: their commands are commands, and systemd takes them."""

import shlex
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from support.processes.command import Kantor

UNITS = Path(__file__).parents[2] / "docker" / "systemd"
SETTINGS = {
    "HUB": "tls/127.0.0.1:7447",
    "LISTEN": "tls/127.0.0.1:7448",
    "SCENARIO": "fleet",
    "OPTIONS": "--seed 3 --set robots.count=10 starts.random=true",
}


def command_of(unit: str, instance: str, folder: Path) -> list[str]:
    """The command of a unit, with systemd's specifiers and the variables of kantor.env filled in."""
    lines = (UNITS / unit).read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("ExecStart="))
    for specifier, value in (("%i", instance), ("%d", folder), ("%S", folder), ("%t", folder)):
        line = line.replace(specifier, str(value))
    for name, value in SETTINGS.items():
        line = line.replace(f"${{{name}}}", value).replace(f"${name}", value)
    return shlex.split(line.partition("=")[2])


@pytest.mark.parametrize(
    ("unit", "instance", "user"),
    [
        ("kantor-worldsim.service", "", "worldsim"),
        ("kantor-robot@.service", "r1", "r1"),
        ("kantor-site@.service", "north", "site-north"),
    ],
)
def test_a_unit_runs_a_command_that_lacks_only_an_identity(
    kantor: "Kantor", unit: str, instance: str, user: str
) -> None:
    """Verb and options are understood: only the file that `LoadCredential=` brings is no good."""
    (kantor.folder / f"{user}.toml").touch()
    program, *arguments = command_of(unit, instance, kantor.folder)
    finished = kantor(*arguments)

    assert program == "/opt/kantor/bin/kantor"
    assert finished.code == 2
    assert f"{user}.toml: not a" in finished.err
    credential = f"LoadCredential={user.replace(instance, '%i') if instance else user}.toml:"
    assert credential in (UNITS / unit).read_text()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
@pytest.mark.parametrize("unit", sorted(path.name for path in UNITS.glob("*.service")))
def test_systemd_takes_the_units(tmp_path: Path, unit: str) -> None:
    """Without a warning, and with little left that a process of the unit could do to its machine."""
    file = tmp_path / unit.replace("@", "@r1")
    file.write_text((UNITS / unit).read_text().replace("/opt/kantor/bin/kantor", "/bin/true"))
    verified = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", file], capture_output=True, text=True, check=False
    )
    exposed = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--threshold=20", file],
        capture_output=True,
        text=True,
        check=False,
    )

    assert verified.stderr == ""
    assert (verified.returncode, exposed.returncode) == (0, 0), exposed.stdout
