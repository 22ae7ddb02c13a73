"""The page on the architecture says what the import contracts enforce, and every room says what belongs there."""

import ast
import re
import tomllib
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


def test_paths_on_the_page_exist() -> None:
    """Every file in the two journeys is in its room."""
    paths = set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", PAGE))
    found = {name for name in paths for path in PACKAGES.values() if (path / name).exists()}

    assert len(paths) >= 15
    assert paths - found == set()


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
