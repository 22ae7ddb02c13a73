"""The page on the architecture says what the import contracts enforce, and every room says what belongs there."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
    "importlinter"
]["contracts"]
LAYERS = {
    contract["containers"][0] if "containers" in contract else "": contract["layers"]
    for contract in CONTRACTS
    if contract["type"] == "layers"
}
HEADS = {
    "kantor": "",
    "protocol": "kantor_protocol",
    "agent": "kantor_agent",
    "supervisor": "kantor_supervisor",
    "world-sim": "kantor_worldsim",
    "fleet": "kantor_fleet",
}
PACKAGES = {
    package: ROOT / folder / package
    for folder in ("protocol", "agent", "supervisor", "worldsim", "fleet")
    for package in (f"kantor_{folder}",)
}


def drawn() -> dict[str, list[str]]:
    """The layers in the page's drawings, by their head."""
    blocks = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    lines = [block.split("\n") for block in blocks]
    return {head: [layer for layer in rest if layer] for head, *rest in lines}


@pytest.mark.parametrize("head", HEADS)
def test_the_drawing_has_the_layers_of_the_contract(head: str) -> None:
    """Layer by layer, from the top."""
    layers = [layer.replace("kantor_", "") for layer in LAYERS[HEADS[head]]]

    assert drawn()[head] == layers


def test_every_room_is_in_a_contract() -> None:
    """A folder or module below a package that no layer names would be free to import anything."""
    for package, path in PACKAGES.items():
        named = {name.strip() for layer in LAYERS[package] for name in layer.split("|")}
        rooms = {
            p.stem for p in path.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()
        }

        assert rooms - {"__init__"} == named


def files_at(place: str) -> list[Path]:
    """The files that a path of the page may mean: below the root, or below a package."""
    return [path / place for path in (ROOT, *PACKAGES.values()) if (path / place).exists()]


def test_paths_on_the_page_exist() -> None:
    """Every file that the page names is in its room, and in one package only."""
    places = set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", PAGE))

    assert len(places) >= 15
    assert [place for place in places if len(files_at(place)) != 1] == []


PLACES = re.findall(r"`([a-z_/]+\.py)`: `([A-Za-z_.]+)`", PAGE)
"""A file and the class, method, function or constant that the page names in it."""


@pytest.mark.parametrize(("file", "name"), PLACES)
def test_what_the_page_names_in_a_file_is_defined_there(file: str, name: str) -> None:
    """`Class.method`, or a name at the top of the file."""
    paths = [
        path for path in (ROOT / file, *(p / file for p in PACKAGES.values())) if path.exists()
    ]
    (tree,) = [ast.parse(path.read_text(encoding="utf-8")) for path in paths]

    assert name in set(_defined_in(tree.body))


def test_the_page_names_places_to_look_at() -> None:
    """At least one for each question of a newcomer."""
    assert len(PLACES) >= 8


def _defined_in(body: list[ast.stmt], prefix: str = "") -> Iterator[str]:
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield prefix + node.name
            if isinstance(node, ast.ClassDef):
                yield from _defined_in(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (prefix + target.id for target in targets if isinstance(target, ast.Name))


@pytest.mark.parametrize(
    "room",
    [
        path.relative_to(ROOT)
        for package in PACKAGES.values()
        for path in sorted(package.rglob("*"))
        if path.is_dir() and any(path.glob("*.py"))
    ],
    ids=str,
)
def test_every_room_says_what_belongs_there(room: Path) -> None:
    """Two to five sentences in its `__init__.py`, and where to start reading."""
    text = ast.get_docstring(ast.parse((ROOT / room / "__init__.py").read_text(encoding="utf-8")))
    sentences = re.findall(r"[.](?=\s|$)", text or "")

    assert 2 <= len(sentences) <= 5, text
