"""Structure in numbers: largest files, fullest rooms, longest functions, repeated class names, retired words.

    python benchmarks/structure.py

A report to read, and no gate: a number here is a place to look at.
"""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("protocol", "agent", "supervisor", "worldsim", "fleet")
SHOWN = 10
RETIRED = (
    "referee", "doorway", "admission", "deed", "incident", "toll", "struck", "sightings", "dice",
    "storm", "diary", "page", "mortal", "birth", "slot", "epoch", "manner", "law", "books", "land",
    "reading", "mailbag", "stage", "act", "ruling", "chart", "terrain", "walk", "roll_call", "void",
    "news", "have", "patience", "hands", "wall", "flight", "by hand", "nobody", "somebody", "whoever",
)  # fmt: skip
"""Words that gave way to the terms of docs/glossary.md, and the people in place of components."""


def sources(*folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted((ROOT / folder).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def largest_files() -> Iterator[str]:
    sizes = {path: len(path.read_text().splitlines()) for path in sources(*PACKAGES, "tests")}
    for path, lines in sorted(sizes.items(), key=lambda item: -item[1])[:SHOWN]:
        yield f"{lines:5}  {name_of(path)}"


def fullest_rooms() -> Iterator[str]:
    rooms = Counter(
        path.parent for path in sources(*PACKAGES, "tests") if path.name != "__init__.py"
    )
    for room, files in rooms.most_common(SHOWN):
        yield f"{files:5}  {name_of(room)}"


def longest_functions() -> Iterator[str]:
    found: list[tuple[int, str]] = []
    for path in sources(*PACKAGES):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                found.append((lines, f"{name_of(path)}:{node.name}"))
    for lines, place in sorted(found, reverse=True)[:SHOWN]:
        yield f"{lines:5}  {place}"


def repeated_classes() -> Iterator[str]:
    places = defaultdict(list)
    for path in sources(*PACKAGES):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.stem)
    for name, files in sorted(places.items()):
        if len(files) > 1:
            yield f"{len(files):5}  {name}: {', '.join(files)}"


def retired_words() -> Iterator[str]:
    text = {path: path.read_text() for path in sources(*PACKAGES)}
    for word in RETIRED:
        pattern = re.compile(rf"(?<![\w.-]){word}s?(?![\w-])", re.IGNORECASE)
        places = Counter({path.stem: len(pattern.findall(text[path])) for path in text})
        total = places.total()
        if total:
            most = ", ".join(f"{stem} {count}" for stem, count in places.most_common(4) if count)
            yield f"{total:5}  {word}: {most}"


def main() -> None:
    for title, lines in (
        ("lines of the largest files", largest_files()),
        ("files of the fullest rooms", fullest_rooms()),
        ("lines of the longest functions", longest_functions()),
        ("class names that stand more than once", repeated_classes()),
        ("retired words in the packages", retired_words()),
    ):
        print(f"\n{title}")
        print("\n".join(lines))


if __name__ == "__main__":
    main()
