"""Every document works as it stands: commands, TOML, links, paths and examples.

Everything goes through the `kantor` command as far as possible, so that no restructuring touches this file.
`test_a_check_fails_when_it_should` shows for each check what it finds.
"""

import contextlib
import functools
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from kantor_fleet.__main__ import VERBS, main

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
GENERATED = ROOT / "docs" / "mutants.md"
DOCUMENTS = [
    README,
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    ROOT / "protocol" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]

FOLDERS = (
    *(".ci", "agent", "benchmarks", "docker", "docs", "fleet", "protocol"),
    *("supervisor", "tests", "worldsim"),
)
"""What is in the repository, whatever else stands beside it."""
PROGRAMS = frozenset(
    {".", "cd", "cp", "docker", "docker-compose", "echo", "find", "install", "journalctl"}
    | {"nft", "pip", "python3", "scp", "systemctl"}
)
"""What documents tell a reader to run beside this repository's own commands."""
FOREIGN_OPTIONS = frozenset({"--nthreads"})
MADE = frozenset({"runs/", "logs/", "state/", "keys/", "sweeps/bay/", "docker/runs/", "nearest.py"})
"""What commands make, and readers."""
RETIRED = re.compile(
    r"\b(no(body|one)|some(body|one)|any(body|one)|everybody|who(so)?ever"
    r"|referees?|doorways?|dia(ry|ries)|on the wall|wall (exchange|run|clock)"
    r"|storms|tolls?|sightings|dice|roll call|mailbag|terrain)\b",
    flags=re.IGNORECASE,
)
"""Words that the glossary has replaced."""
RETIRED_NAMES = re.compile(
    r"\b(Doorway|Admission|Hands|Deeds?|Incident|Toll|Life|Mortal|Diary|Manner|Law|Books|Land"
    r"|Reading|Reader|Mailbag|Stage|Act|Ruling|Verdict|Chart|Terrain|Field|News|Turn|Go)\b"
)
"""Names in the code likewise, as they stand in backticks."""

needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="no make here")


class Block(NamedTuple):
    """A fenced block."""

    language: str
    text: str


class Document(NamedTuple):
    """A text, and where it stands."""

    path: Path
    text: str

    @classmethod
    def of(cls, path: Path) -> "Document":
        return cls(path, path.read_text(encoding="utf-8"))

    def blocks(self, *languages: str) -> list[Block]:
        """Its fenced blocks, of some languages."""
        found = re.findall(r"^```(\w*)\n(.*?)^```$", self.text, flags=re.DOTALL | re.MULTILINE)
        return [Block(*block) for block in found if not languages or block[0] in languages]

    @property
    def prose(self) -> str:
        """Without its fenced blocks."""
        return re.sub(r"^```.*?^```$", "", self.text, flags=re.DOTALL | re.MULTILINE)

    @property
    def spans(self) -> list[str]:
        """What stands in backticks."""
        return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", self.prose)]


class Ended(NamedTuple):
    """How the command ended, and with which verb and values it would have run."""

    code: int
    out: str
    err: str
    verb: str | None
    values: dict[str, Any]


def kantor(*arguments: str, act: bool = True) -> Ended:
    """The `kantor` command in this process. act: run the verb; otherwise only parse the command line."""
    reached: list[tuple[str, dict[str, Any]]] = []

    def stub(name: str, verb: Callable[..., int]) -> Callable[..., int]:
        @functools.wraps(verb)
        def reach(*places: Any, **named: Any) -> int:
            reached.append((name, dict(enumerate(places)) | named))  # type: ignore[arg-type]
            return 0

        return reach

    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["kantor", *arguments])
        patch.setenv("COLUMNS", "200")
        if not act:
            stubs = {name: stub(name, verb) for name, verb in VERBS.items()}
            patch.setattr("kantor_fleet.__main__.VERBS", stubs)
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            pytest.raises(SystemExit) as ended,
        ):
            main()
    verb, values = reached[0] if reached else (None, {})
    return Ended(int(ended.value.code or 0), out.getvalue(), err.getvalue(), verb, values)


@functools.cache
def options_of(verb: str) -> frozenset[str]:
    """The options of a verb; empty if there is no such verb."""
    ended = kantor(verb, "--help", act=False)
    return frozenset(re.findall(r"--[a-z][a-z-]*", ended.out)) if ended.code == 0 else frozenset()


@functools.cache
def verbs() -> frozenset[str]:
    """All verbs, as the command lists them."""
    names = set(re.findall(r"[a-z]+", kantor("--help", act=False).out))
    return frozenset(name for name in names if options_of(name))


@functools.cache
def all_options() -> frozenset[str]:
    """Options of verbs, of benchmarks and of scripts."""
    own = frozenset().union(*(options_of(verb) for verb in verbs()))
    sources = (path for folder in ("benchmarks", "docker") for path in (ROOT / folder).glob("*.*"))
    texts = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    return own | frozenset(re.findall(r"--[a-z][a-z-]*", texts)) | FOREIGN_OPTIONS


# Commands.


def commands(document: Document) -> Iterator[list[str]]:
    """The commands of the console blocks, as words."""
    for block in document.blocks("console", "bash", "sh", "shell"):
        for line in block.text.replace("\\\n", " ").splitlines():
            for command in re.split(r"\s&&\s|\s\|\s", line):
                words = shlex.split(command, comments=True)
                while words and (re.match(r"[A-Z_]+=", words[0]) or words[0] == "sudo"):
                    words.pop(0)
                if words:
                    yield words


def complaints_of_commands(document: Document, folder: Path) -> Iterator[str]:
    """Commands that do not parse, name what is not there, or would run no scenario."""
    files = {scenario_name(text): text for text in toml_of(document)}
    for words in commands(document):
        program, *arguments = words
        complaint: str | None = None
        if Path(program).name == "kantor":
            complaint = complaint_of_kantor(arguments, files, folder)
        elif program == "make":
            complaint = complaint_of_make(arguments)
        elif program == "python":
            complaint = complaint_of_script(arguments)
        elif program == "docker-compose":
            complaint = complaint_of_compose(arguments)
        elif (ROOT / program).is_file():
            continue
        elif not {program, Path(program).name} & PROGRAMS:
            complaint = "not a program that documents use"
        if complaint is not None:
            yield f"{shlex.join(words)}: {complaint}"


def complaint_of_kantor(arguments: list[str], files: dict[str, str], folder: Path) -> str | None:
    """Why a command line of kantor's does not run. files: the TOML that the document shows."""
    ended = kantor(*arguments, act=False)
    if ended.code != 0:
        return " ".join(re.sub(r"[^\w .:-]", "", ended.err + ended.out).split())
    if ended.verb in {"run", "worldsim", "sweep"} and ended.values.get("resume") is None:
        return complaint_of_mission(ended, files, folder)
    if ended.verb == "scenarios" and ended.values.get(0) == "show":
        return None if kantor(*arguments).code == 0 else "no such scenario"
    return None


def complaint_of_mission(ended: Ended, files: dict[str, str], folder: Path) -> str | None:
    """Why a mission would not begin."""
    name = ended.values[0]
    text = files.get(name) if name.endswith(".toml") else kantor("scenarios", "show", name).out
    if text is None:
        return f"{name}: the document does not show it"
    if (chaos := ended.values["chaos"]) is not None:
        if (faults := files.get(str(chaos))) is None:
            return f"{chaos}: the document does not show it"
        text += "\n" + faults
    variants = [ended.values["set"]]
    for varied in ended.values.get("vary", ()):
        key, _, values = varied.partition("=")
        variants += [(*ended.values["set"], f"{key}={value}") for value in values.split(",")]
    refusals = (refusal_of(text, folder, overrides) for overrides in variants)
    return next((refusal for refusal in refusals if refusal is not None), None)


def refusal_of(text: str, folder: Path, overrides: Iterable[str] = ()) -> str | None:
    """Why a scenario is refused. `kantor compose` reads one and runs nothing."""
    try:
        robots = tomllib.loads(text)["robots"]["count"]
    except (tomllib.TOMLDecodeError, KeyError) as error:
        return f"no scenario: {error}"
    (folder / "of").mkdir(exist_ok=True)
    (folder / "of" / "document.toml").write_text(text, encoding="utf-8")
    with contextlib.chdir(folder):
        ended = kantor(
            *("compose", "--scenario", "of/document.toml", "--robots", str(robots)),
            *("--supervisor", "--out", "of/compose.yaml"),
            *(word for override in overrides for word in ("--set", override)),
        )
    return None if ended.code == 0 else ended.err.strip()


def complaint_of_make(targets: list[str]) -> str | None:
    """Why make does not know a target."""
    ended = subprocess.run(
        ["make", "--dry-run", *targets], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return None if ended.returncode == 0 else ended.stderr.strip()


def complaint_of_script(arguments: list[str]) -> str | None:
    """Why a script of this repository does not take these arguments."""
    script = ROOT / arguments[0]
    if not script.is_file():
        return "no such script"
    text = script.read_text(encoding="utf-8")
    unknown = [word for word in arguments[1:] if word.startswith("--") and word not in text]
    return f"no option {unknown[0]}" if unknown else None


def complaint_of_compose(arguments: list[str]) -> str | None:
    """Why the compose file of this repository does not take these arguments."""
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
    profiles = {name for service in services.values() for name in service.get("profiles", ())}
    for option, known in (("--exit-code-from", set(services)), ("--profile", profiles)):
        if option in arguments and (name := arguments[arguments.index(option) + 1]) not in known:
            return f"no {name} in docker/compose.yaml"
    if arguments[0] == "run" and arguments[-1] not in services:
        return f"no {arguments[-1]} in docker/compose.yaml"
    return None


def complaints_of_spans(document: Document) -> Iterator[str]:
    """Verbs, options and targets in backticks that there are not."""
    for span in document.spans:
        words = span.split()
        if words[0] == "kantor" and len(words) > 1:
            verb, options = words[1], {word for word in words if word.startswith("--")}
            if verb != "--help" and verb not in verbs():
                yield f"`{span}`: no such verb"
            elif unknown := options - options_of(verb) - {"--help"}:
                yield f"`{span}`: no option {min(unknown)}"
        elif words[0] == "make" and len(words) > 1:
            if (complaint := complaint_of_make(words[1:2])) is not None:
                yield f"`{span}`: {complaint}"
        elif re.match(r"--[a-z]", span) and words[0].partition("=")[0] not in all_options():
            yield f"`{span}`: no such option"


# TOML.


def toml_of(document: Document) -> list[str]:
    return [block.text for block in document.blocks("toml")]


def scenario_name(text: str) -> str:
    """The file that a reader saves a block as: a scenario's name, or faults.toml."""
    try:
        return f"{tomllib.loads(text).get('name', 'faults')}.toml"
    except tomllib.TOMLDecodeError:
        return ""


def complaints_of_toml(document: Document, folder: Path) -> Iterator[str]:
    """Blocks that are no scenario, and no faults for one."""
    fleet = kantor("scenarios", "show", "fleet").out
    for text in toml_of(document):
        whole = f"{fleet}\n{text}" if scenario_name(text) == "faults.toml" else text
        if (refusal := refusal_of(whole, folder)) is not None:
            yield refusal


# Links and paths.


@functools.cache
def headings(path: Path) -> frozenset[str]:
    """The anchors of a document."""
    titles = re.findall(r"^#+ (.*)$", Document.of(path).prose, flags=re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles)


def links(document: Document) -> list[tuple[str, str]]:
    """Links and pictures inside the repository: file and anchor."""
    return re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", document.prose)


def complaints_of_links(document: Document) -> Iterator[str]:
    """Links that lead nowhere."""
    for target, anchor in links(document):
        file = document.path.parent / target if target else document.path
        if not file.exists():
            yield f"{target}: no such file"
        elif anchor and anchor not in headings(file.resolve()):
            yield f"{target}#{anchor}: no such heading"


@functools.cache
def tree() -> frozenset[str]:
    """Every file and folder of the repository, from its root and from below."""
    inside = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*"))
    whole = [
        *map(Path, FOLDERS),
        *(path.relative_to(ROOT) for path in (*ROOT.glob("*.*"), *inside)),
    ]
    return frozenset("/".join(path.parts[i:]) for path in whole for i in range(len(path.parts)))


def complaints_of_paths(document: Document) -> Iterator[str]:
    """Files, folders and modules in backticks that there are not."""
    for span in document.spans:
        if re.fullmatch(r"kantor_\w+(\.\w+)+", span):
            place = span.replace(".", "/")
            if not {place, f"{place}.py"} & tree():
                yield f"`{span}`: no such module"
        elif re.fullmatch(r"[\w.-]+(/[\w.@-]+)*/?", span):
            inside = "/" in span and span.partition("/")[0] in FOLDERS
            is_path = span.endswith((".py", ".md", ".sh", ".service", "/")) or inside
            if is_path and span.rstrip("/") not in tree() and span not in MADE:
                yield f"`{span}`: no such path"


# Words.


def complaints_of_words(document: Document) -> Iterator[str]:
    """Words and names that the glossary has replaced."""
    text = " ".join(re.sub(r"`[^`]*`", "", document.prose).split())
    for found in RETIRED.finditer(text):
        yield f"{found[0]}: …{text[max(0, found.start() - 30) : found.end() + 30]}…"
    for span in document.spans:
        if RETIRED_NAMES.search(span):
            yield f"`{span}`"


# The documents.

each = pytest.mark.parametrize(
    "path", DOCUMENTS, ids=[path.relative_to(ROOT).as_posix() for path in DOCUMENTS]
)


@needs_make
@each
def test_every_command_runs(path: Path, tmp_path: Path) -> None:
    """In console blocks, with their scenarios and overrides; and in backticks."""
    document = Document.of(path)

    assert [*complaints_of_commands(document, tmp_path), *complaints_of_spans(document)] == []


@each
def test_every_toml_is_a_scenario(path: Path, tmp_path: Path) -> None:
    """Or faults that can be added to one."""
    assert list(complaints_of_toml(Document.of(path), tmp_path)) == []


@each
def test_every_link_leads_somewhere(path: Path) -> None:
    """Links and pictures inside the repository, anchors included."""
    assert list(complaints_of_links(Document.of(path))) == []


@each
def test_every_path_exists(path: Path) -> None:
    """Files, folders and modules in backticks."""
    assert list(complaints_of_paths(Document.of(path))) == []


@each
def test_every_word_is_one_of_the_glossary(path: Path) -> None:
    """None that it has replaced; the table of planted bugs is written by a script."""
    if path != GENERATED:
        assert list(complaints_of_words(Document.of(path))) == []


@each
def test_every_example_is_python(path: Path) -> None:
    """Python blocks compile."""
    for block in Document.of(path).blocks("python"):
        compile(block.text, str(path), "exec")


def test_every_document_can_be_found() -> None:
    """Each is linked from another, and there are links, commands and TOML to be checked at all."""
    documents = [Document.of(path) for path in DOCUMENTS]
    linked = {
        (document.path.parent / target).resolve()
        for document in documents
        for target, _ in links(document)
        if target
    }

    assert [path for path in DOCUMENTS if path not in linked and path != README] == []
    assert len(linked) > 80
    assert sum(len(list(commands(document))) for document in documents) > 60
    assert sum(len(toml_of(document)) for document in documents) >= 4


def test_the_readme_is_one_page() -> None:
    """At most 150 lines of at most 120 characters."""
    lines = README.read_text(encoding="utf-8").splitlines()

    assert len(lines) <= 150
    assert [line for line in lines if len(line) > 120] == []


BAD = {
    "option": (complaints_of_commands, "```console\nkantor run --sped 3\n```"),
    "verb": (complaints_of_commands, "```console\nkantor rum fleet\n```"),
    "value": (complaints_of_commands, "```console\nkantor run --seed many\n```"),
    "two values": (complaints_of_commands, "```console\nkantor verify one two\n```"),
    "two values of an option": (complaints_of_commands, "```console\nkantor tap --count 1 2\n```"),
    "scenario": (complaints_of_commands, "```console\nkantor run nowhere\n```"),
    "own scenario": (complaints_of_commands, "```console\nkantor run other.toml\n```"),
    "own faults": (complaints_of_commands, "```console\nkantor run --chaos other.toml\n```"),
    "override": (complaints_of_commands, "```console\nkantor run --set radio.rang_m=3\n```"),
    "second override": (
        complaints_of_commands,
        "```console\nkantor run --set radio.drop=0.1 planner=psychic\n```",
    ),
    "variant": (complaints_of_commands, "```console\nkantor sweep --vary merge=min,max\n```"),
    "after and": (complaints_of_commands, "```console\ncd docker && kantor rum\n```"),
    "target": (complaints_of_commands, "```console\nmake nothing\n```"),
    "script": (complaints_of_commands, "```console\npython benchmarks/nothing.py\n```"),
    "script's option": (complaints_of_commands, "```console\npython benchmarks/run.py --no\n```"),
    "program": (complaints_of_commands, "```console\nkantr run\n```"),
    "service": (complaints_of_commands, "```console\ndocker-compose run --rm nothing\n```"),
    "verb in prose": (complaints_of_spans, "`kantor rum`"),
    "option in prose": (complaints_of_spans, "`kantor verify --sped`"),
    "option alone": (complaints_of_spans, "`--sped 3`"),
    "target in prose": (complaints_of_spans, "`make nothing`"),
    "TOML": (complaints_of_toml, "```toml\nname = \n```"),
    "key": (complaints_of_toml, '```toml\nname = "a"\nrobot = { count = 1 }\n```'),
    "fault": (complaints_of_toml, '```toml\n[[faults]]\nkind = "kil"\n```'),
    "fault's robot": (complaints_of_toml, '```toml\n[[faults]]\nkind = "kill"\nwho = ["r9"]\n```'),
    "link": (complaints_of_links, "[a link](nowhere.md)"),
    "picture": (complaints_of_links, "![a picture](docs/nowhere.png)"),
    "anchor": (complaints_of_links, "[a link](CONTRIBUTING.md#nowhere)"),
    "file": (complaints_of_paths, "`agent/kantor_agent/nowhere.py`"),
    "short file": (complaints_of_paths, "`nowhere.py`"),
    "folder": (complaints_of_paths, "`agent/nowhere`"),
    "short folder": (complaints_of_paths, "`nowhere/`"),
    "module": (complaints_of_paths, "`kantor_agent.nowhere`"),
    "word": (complaints_of_words, "Whoever reads this."),
    "name": (complaints_of_words, "`Stage.settle`"),
}


@needs_make
@pytest.mark.parametrize("name", BAD)
def test_a_check_fails_when_it_should(name: str, tmp_path: Path) -> None:
    """Each with one thing that is wrong."""
    check, text = BAD[name]
    takes_folder = check in {complaints_of_commands, complaints_of_toml}
    document = Document(README, text)

    assert list(check(document, tmp_path) if takes_folder else check(document))  # type: ignore[operator]


# The examples.


def example(path: Path, name: str) -> str:
    """A class that a document prints."""
    blocks = Document.of(path).blocks("python")
    (text,) = (block.text for block in blocks if f"class {name}:" in block.text)
    return text


def defined(text: str, name: str) -> Any:
    names: dict[str, Any] = {}
    exec(text, names)
    return names[name]


def played(out: Path, *arguments: str) -> dict[str, Any]:
    """The result of a mission in process, with every checker."""
    ended = kantor("run", *arguments, "--exchange", "in-process", "--out", str(out))
    (result,) = (json.loads(path.read_text()) for path in out.glob("*/result.json"))
    assert ended.code == 0, ended.err
    assert (result["ended"], result["complaints"]) == ("done", [])
    return result  # type: ignore[no-any-return]


def test_the_planner_in_the_readme_explores(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The example as printed, in the README and for planners, runs a mission to its end."""
    from kantor_agent.planners.registry import PLANNERS

    text = example(README, "Nearest")
    assert text == example(ROOT / "docs" / "planners.md", "Nearest")
    monkeypatch.setitem(PLANNERS, "transport", lambda _scenario: defined(text, "Nearest")())
    result = played(
        tmp_path, "paper-decentralized", "--set", "energy.points=400", "samples.count=200"
    )

    assert result["mass_left"] == 0.0
    assert (
        result["w_ub"]["paper"] < 0.5 * result["w_ub_start"]
    )  # where it stands still it does not fall


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_the_planner_on_maps_explores(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, coordination: str
) -> None:
    """In every robot and in the supervisor, as printed."""
    from kantor_agent.planners.map_registry import ALLOCATORS

    polite = defined(example(ROOT / "docs" / "planners.md", "Polite"), "Polite")
    monkeypatch.setitem(ALLOCATORS, "burgard", polite)
    result = played(tmp_path, "office", "--set", f"coordination={coordination}")

    assert result["map"]["explored"] == 1.0


def test_the_storm_of_the_documents_is_the_packaged_one(tmp_path: Path) -> None:
    """Thirty lines at most; a partition from 200 to 500 s, a robot and the supervisor killed, and it ends."""
    text = kantor("scenarios", "show", "storm").out
    assert f"```toml\n{text}```" in (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 30

    result = played(tmp_path, "storm")
    assert result["restarts"] == 2
    assert result["finished_tick"] is not None
