"""Behaviour that must not change: digests of short missions, and run folders written by version 0.1.0.

Everything goes through the `kantor` command and TOML, so that no restructuring touches this file. A
digest covers every record of a mission: inputs, outputs, radio decisions, truth and metrics.
"""

import json
import shutil
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from kantor_fleet.__main__ import main

if TYPE_CHECKING:
    from support.processes.command import Kantor

BASELINE = Path(__file__).parent / "baseline"

LINKS = ("--chaos", str(BASELINE / "links.toml"))
PROCESSES = ("--chaos", str(BASELINE / "processes.toml"))
SMALL = ("energy.points=600", "samples.count=400", "targets.count=60")
SLOW = ("clock.period_s=1.0", "vehicle.speed_m_s=20", "limit_s=90", "radio.range_m=500", *SMALL)
SPECTRAL = ("planner.name=spectral", "planner.modes=8")
LOSSY = ("radio.drop=0.1", "radio.duplicate=0.1", "radio.delay_s=0.03", "radio.jitter_s=0.2")
CENTRALIZED = ("coordination=centralized",)
MAP = ("limit_s=60",)

MISSIONS = {
    "ledger": (
        "fleet",
        0,
        (),
        SMALL,
        "c20b44bc934ba5d80893d004739a26428a6cf4f679335223fe7f8f47c64e1723",
    ),
    "ledger-other-seed": (
        "fleet",
        7,
        (),
        SMALL,
        "fb023d00ebd2372beb576a68a6cbfc3d9636b0860fa3996f0ab76bc35b66454c",
    ),
    "ledger-lossy": (
        "fleet",
        1,
        (),
        (*SMALL, *LOSSY),
        "3a5d0b83e434f49d04feba57d0fbb403c22aee3db27a644e34633b6627a9066d",
    ),
    "minimum": (
        "fleet",
        2,
        (),
        (*SMALL, "merge=min", "claims=false"),
        "bde9c926263fafbac435241b5bcf9138248504e0f9c7e54899918ad127601f50",
    ),
    "single": (
        "paper-single",
        3,
        (),
        ("energy.points=300",),
        "a5c091f6545a7509a9737fde6910a96cbd933d5a7c50f4272d957839309d97b0",
    ),
    "in-turn": (
        "paper-centralized",
        4,
        (),
        SMALL,
        "e3043f59c8704ea0fd9971847387da0fad17894013af2311c81551d153d40fc1",
    ),
    "concurrent": (
        "paper-centralized-concurrent",
        5,
        (),
        SMALL,
        "6da88cb114200fb896efaba88d9200f72f626042fab36116a08d0b67a1f2079a",
    ),
    "state-beacon": (
        "paper-decentralized",
        6,
        (),
        SMALL,
        "14a6aa24622632a3981a70dfbc59c80ec7cbc7288c863b5a31dfbbccd8e48ce7",
    ),
    "walking-targets": (
        "paper-timevarying",
        7,
        (),
        ("energy.points=300",),
        "b4e28f127f7c62c6a0df96a6b641d9e987fe6b9ecf68a0f9df2be53d474ee728",
    ),
    "dubins": (
        "fleet",
        8,
        (),
        (*SMALL, "vehicle.name=dubins", "clock.jitter_s=0.02"),
        "6143d74f67ff8e0de88db26b22da55e69581fa0592d9fd6df530a0916ddd7608",
    ),
    "spectral": (
        "fleet",
        9,
        (),
        (*SMALL, *SPECTRAL),
        "d4bc77656998f4a953767b51a0056e208efe5d23476da41d077e68d7e6a54bfa",
    ),
    "spectral-supervisor": (
        "fleet",
        9,
        (),
        (*SMALL, *SPECTRAL, *CENTRALIZED),
        "e8a825e73ab3ae4c26e1b231978b9327367785c7fb026e62b5c6738e3617c331",
    ),
    "links": (
        "fleet",
        10,
        LINKS,
        SLOW,
        "5e8dd3f46471c0371b62f2ab9e3a9375cc214a29446621857d383b1adc6851e4",
    ),
    "links-minimum": (
        "fleet",
        11,
        LINKS,
        (*SLOW, "merge=min", "claims=false"),
        "3aaef826f096311d56dfd43a90e6d911ebdda55eb7eac9634363d8d686cf0da1",
    ),
    "processes": (
        "fleet",
        12,
        PROCESSES,
        SLOW,
        "d559849e4e0e13fb29ba9c1e2117453e827daa48deb765c56f422f90f9dfac3a",
    ),
    "processes-supervisor": (
        "fleet",
        13,
        PROCESSES,
        (*SLOW, *CENTRALIZED),
        "7fc78123c73c3cf1d6cc46b06d63705c24d2fdf09ba042eec0eea4ee7238c75c",
    ),
    "burgard": (
        "office",
        14,
        (),
        MAP,
        "de7873ee82e11e9bfd95d329bac8e142cbabf05ddfccd97e8b806cda584354f1",
    ),
    "burgard-supervisor": (
        "office",
        15,
        (),
        (*MAP, *CENTRALIZED),
        "44da83fe06be7004bff0cd6164214ace4058972ee90c48e5eaeb004c66b0c683",
    ),
    "burgard-storm": (
        "office",
        16,
        LINKS,
        ("limit_s=90", "vehicle.name=unicycle"),
        "da0bb5d6e4afaf8fce53ca3c0e39152d9a9b209c5aa222813b195e5e73ad027f",
    ),
    "burgard-killed": (
        "office",
        17,
        PROCESSES,
        MAP,
        "e9284fe34dd417a51711dd1ddf62ba09291778dc8d236499b3c36000d0b09edc",
    ),
    "frontier": (
        "office",
        18,
        (),
        (*MAP, "planner.name=frontier", "sensor.noise_m=0.02"),
        "947295dff36555dd25c3937525477c2b7b7fc45623feb0747460b162adf71cc1",
    ),
    "hungarian": (
        "office",
        19,
        (),
        (*MAP, "planner.name=hungarian"),
        "53d44f0d58f556232269d37cae03009a87afa89d3846af4e580e1d62fe5118f5",
    ),
    "market": (
        "office",
        20,
        (),
        (*MAP, "planner.name=market", "radio.wall_loss_m=2"),
        "bf20fa925a66d9dab637ff5cef8f688d7ca503c2dcc43d2eac25c2007fded32f",
    ),
    "kmeans": (
        "unstructured",
        21,
        (),
        ("limit_s=120",),
        "0f489f0961e0be4e526439d3f98710976afae8a41edb9b00cb2f7b88f55a220f",
    ),
}
RESUMED = "a0bc9c442043036880b1083ca6e2abe8af07607def3017e0bd994d25a87a83a2"
LOCKSTEP = ("ledger-lossy", "processes", "processes-supervisor", "spectral", "burgard-killed")


def arguments(name: str) -> list[str]:
    scenario, seed, options, overrides, _ = MISSIONS[name]
    return ["run", scenario, "--seed", str(seed), *options, "--set", *overrides]


def digest_in(folder: Path) -> str:
    (run,) = (folder / "runs").iterdir()
    result = json.loads((run / "result.json").read_text())
    assert result["violations"] == 0
    return str(result["digest"])


@pytest.mark.parametrize("name", MISSIONS)
def test_digest_in_process(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mission has the digest that it had in version 0.1.0."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)  # takes seconds
    monkeypatch.setattr(sys, "argv", ["kantor", *arguments(name), "--exchange", "in-process"])
    with pytest.raises(SystemExit) as ended:
        main()

    assert ended.value.code in {0, 1}  # 1: cut by its limit
    assert digest_in(tmp_path) == MISSIONS[name][-1]


@pytest.mark.parametrize("name", LOCKSTEP)
def test_digest_in_lockstep(name: str, kantor: "Kantor") -> None:
    """A mission of real processes has the same digest."""
    finished = kantor(*arguments(name), "--exchange", "lockstep")

    assert finished.code in {0, 1}, finished.err
    assert digest_in(kantor.folder) == MISSIONS[name][-1]


@pytest.mark.parametrize("exchange", ["in-process", "lockstep", "wall"])
def test_a_run_of_version_0_1_0_is_verified(
    exchange: str, tmp_path: Path, kantor: "Kantor"
) -> None:
    """A run folder is read, checked and executed again; `report.png` was left out of it."""
    folder = shutil.copytree(BASELINE / exchange, tmp_path / exchange)
    finished = kantor("verify", folder)

    assert finished.code == 0, finished.out + finished.err
    assert "FAIL" not in finished.out


def test_a_cut_off_run_of_version_0_1_0_is_resumed(tmp_path: Path, kantor: "Kantor") -> None:
    """World-sim goes on from the record, robots and supervisor from their write-ahead logs, to the same end."""
    for part in ("run", "state"):
        shutil.copytree(BASELINE / "cut-off" / part, tmp_path / part)
    endpoint = free_endpoint()
    others = [
        kantor.start(*words, "--connect", endpoint)
        for words in (("agent", "r1"), ("agent", "r2"), ("supervisor",))
    ]
    finished = kantor("worldsim", "--resume", "run", "--listen", endpoint)

    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert finished.code == 1, finished.err  # cut by its limit
    assert [other.wait(timeout=60) for other in others] == [0, 0, 0]
    assert result["violations"] == 0
    assert result["digest"] == RESUMED
    assert kantor("verify", "run").code == 0


def free_endpoint() -> str:
    """An endpoint on loopback that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
