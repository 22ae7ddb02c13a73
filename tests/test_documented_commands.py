"""Every `kantor` command of every document is executed: as printed, with what keeps it short put behind it.

`test_readme.py` reads the documents and checks the rest in them. Endpoints become free ones on loopback, and names of
machines become this one. What needs more than this machine is executed by the tests that `ELSEWHERE` names.
"""

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from PIL import Image

import test_readme as documents
from kantor_protocol.transport.endpoint import free_endpoint
from support.processes.fleets import await_line

if TYPE_CHECKING:
    from support.processes.command import Kantor

Words = tuple[str, ...]

ELSEWHERE = {
    "chaos": "containers/test_containers.py",
    "site": "processes/test_sites.py",
    "reproduce": "fleet/test_reproduce.py",
}
"""Verbs that need containers, several machines or hours, and the tests that execute them."""
SHORT: dict[str, Words] = {
    "run": ("--set", "limit_s=0.4"),
    "sweep": ("--seeds", "0:1", "--jobs", "1", "--set", "limit_s=0.4"),
    "campaign": ("--seeds", "0:1"),
}
"""What keeps a verb short. Of an option that is given twice the last one counts."""
CODES = {"run": {0, 1}, "worldsim": {0, 1, 130}}
"""Exit codes that are right; a mission that is cut by its limit has 1. Of other verbs 0."""


def documented() -> Iterator[tuple[Path, Words]]:
    """Every command with its document, in order; each once in a document."""
    for path in documents.DOCUMENTS:
        found = documents.commands(documents.Document.of(path))
        kantors = (tuple(words[1:]) for words in found if Path(words[0]).name == "kantor")
        yield from ((path, words) for words in dict.fromkeys(kantors))


COMMANDS = list(documented())
BUS = {"worldsim", "agent", "supervisor", "tap", "site"}
ALONE = sorted(
    {words for _, words in COMMANDS if words[0] not in {*BUS, *ELSEWHERE, "verify", "keys"}}
)


@pytest.fixture
def files(kantor: "Kantor") -> "Kantor":
    """The command, in a folder with the files that the documents show or tell a reader to have."""
    for path in documents.DOCUMENTS:
        for text in documents.toml_of(documents.Document.of(path)):
            (kantor.folder / documents.scenario_name(text)).write_text(text, encoding="utf-8")
    grey = Image.radial_gradient("L").resize((80, 80))
    grey.save(kantor.folder / "field.png")
    Image.new("L", (80, 80), 254).save(kantor.folder / "warehouse.png")
    (kantor.folder / "warehouse.yaml").write_text(
        "image: warehouse.png\nresolution: 0.25\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return kantor


@pytest.mark.parametrize("words", ALONE, ids=" ".join)
def test_a_command_of_a_document_runs(files: "Kantor", words: Words) -> None:
    """To its end, with an exit code that is right, and without a traceback."""
    finished = files(*words, *(() if "--replay" in words or "--help" in words else _short(words)))

    assert finished.code in CODES.get(words[0], {0}), finished.out + finished.err
    assert "Traceback" not in finished.err


def _short(words: Words) -> Words:
    if "--processes" in words:
        return ("--seeds", "1", "--minutes", "0.01", "--storm", "10")
    with_faults = "--chaos" in words or "storm" in words  # they must have their time
    return () if with_faults else SHORT.get(words[0], ())


def test_a_run_of_a_document_is_verified(files: "Kantor") -> None:
    """The commands that verify, after those that leave what they verify."""
    pairs = {words for _, words in COMMANDS if words[0] == "verify"}
    assert files("run", "fleet", "--seed", "3", "--exchange", "in-process", *SHORT["run"]).code == 1
    for verb, pattern in pairs:
        (folder,) = files.folder.glob(pattern)
        finished = files(verb, folder)
        assert finished.code == 0, finished.out + finished.err


def test_keys_of_documents_are_made(files: "Kantor") -> None:
    """In their order, document by document."""
    for path in dict.fromkeys(path for path, _ in COMMANDS):
        shutil.rmtree(files.folder / "keys", ignore_errors=True)
        for words in (words for document, words in COMMANDS if document == path):
            if words[0] == "keys":
                finished = files(*words)
                assert finished.code == 0, finished.out + finished.err


def here(words: Words, endpoints: dict[str, str]) -> Words:
    """A command with the endpoints of this test instead of those of the document."""
    return tuple(endpoints.get(word, word) for word in words)


def test_the_fleet_of_the_documents_meets_and_is_tapped(files: "Kantor") -> None:
    """World-sim, both robots and the tap, as the tutorial has them, on a live bus; and again after a kill."""
    tutorial = [words for path, words in COMMANDS if path.name == "tutorial.md"]
    there = "tcp/127.0.0.1:7447"
    endpoints = {there: free_endpoint()}
    (world_words,) = (words for words in tutorial if words[0] == "worldsim" and there in words)
    world = files.start(*here(world_words, endpoints))
    await_line(world, "t=")
    robots = [files.start(*here(words, endpoints)) for words in tutorial if words[0] == "agent"]
    await_line(world, "t=", "energy")
    (tap_words,) = (words for words in tutorial if words[0] == "tap")
    tap = files.start(*tap_words, "--connect", endpoints[there])
    for kind in ("pose", "weights"):
        assert " B  " in await_line(tap, "", f" {kind} ")
    tap.send_signal(signal.SIGINT)
    out, err = tap.communicate()
    kinds = {line.split()[2] for line in out.splitlines()}
    assert (tap.returncode, err) == (0, "")
    assert kinds <= {"pose", "weights"}

    world.kill()
    world.wait()
    (folder,) = files.runs()
    resumed_words = next(words for words in tutorial if "--resume" in words)
    resumed = files.start(
        *(str(folder) if word == "RUN" else word for word in resumed_words),
        *("--listen", endpoints[there]),
    )
    await_line(resumed, "t=", "energy")
    resumed.send_signal(signal.SIGINT)
    resumed.communicate()
    assert resumed.returncode == 130
    assert [robot.wait() for robot in robots] == [0, 0]


def test_the_fleet_across_machines_meets(files: "Kantor") -> None:
    """With the certificates of the README, on this machine instead of three."""
    readme = [words for path, words in COMMANDS if path == documents.README]
    (keys_words,) = (words for words in readme if words[0] == "keys")
    port = free_endpoint().rpartition(":")[2]
    hub = f"tls/127.0.0.1:{port}"
    endpoints = {
        "hub.example": "127.0.0.1",
        **dict.fromkeys(("tls/0.0.0.0:7447", "tls/hub.example:7447"), hub),
    }
    assert files(*here(keys_words, endpoints)).code == 0
    for identity in (files.folder / "keys").glob("*.toml"):
        shutil.copy(identity, files.folder)
    (world_words,) = (words for words in readme if words[0] == "worldsim" and "tls" in str(words))
    world = files.start(
        *here(world_words, endpoints), *("--start-after", "1", "--set", "limit_s=100000")
    )
    await_line(world, "t=")
    (robot_words,) = (words for words in readme if words[0] == "agent" and "tls" in str(words))
    robot = files.start(*here(robot_words, endpoints))
    await_line(world, "t=", "energy")
    world.send_signal(signal.SIGINT)
    world.communicate()

    assert (world.returncode, robot.wait()) == (130, 0)


def test_no_command_of_a_document_is_left_out() -> None:
    """Each is executed here, or by a test that is there and executes that verb."""
    executed = {*BUS, *ELSEWHERE, "verify", "keys", *(words[0] for words in ALONE)}
    assert {words[0] for _, words in COMMANDS} <= executed
    for verb, file in ELSEWHERE.items():
        text = (Path(__file__).parent / file).read_text(encoding="utf-8")
        assert f'"{verb}"' in text, file
    assert len(ALONE) > 25
