"""Names of files in a scenario: made absolute where they were written, and opened where they are used.

A scenario is text on disk and on the bus, so a name that is not UTF-8 is a `file:` URI in it (RFC 8089).
"""

from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from kantor_protocol.scenario.errors import ScenarioError

KEYS = ("map.file", "samples.file", "targets.file")
"""Keys of a scenario that name files."""
_URI = "file:///"


def path_of(name: str) -> Path:
    """The path that a name in a scenario stands for."""
    if not name.startswith(_URI):
        return Path(name)
    return Path("/" + unquote_to_bytes(name.removeprefix(_URI)).decode("utf-8", "surrogateescape"))


def rooted(tree: Any, folder: Path, key: str = "") -> Any:
    """Parsed TOML in which the names of files are absolute: `~` is a home, and other names are below `folder`.

    key: the place of the tree in a scenario. Raises ScenarioError for a name that no file can have.
    """
    if isinstance(tree, dict):
        return {
            part: rooted(below, folder, f"{key}.{part}".lstrip(".")) for part, below in tree.items()
        }
    return _placed(tree, folder, key) if key in KEYS and isinstance(tree, str) else tree


def _placed(name: str, folder: Path, key: str) -> str:
    try:
        path = (folder / path_of(name).expanduser()).absolute()
        path.stat()  # unlike `exists`, it raises for a name that no file can have
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass  # whoever reads the file says so
    except RuntimeError:
        raise ScenarioError(f"{key}: {name}: no such home; write the folder out") from None
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{key}: {name}: cannot be the name of a file: {error}") from None
    return name_of(path)


def name_of(path: Path) -> str:
    """The name of an absolute path in a scenario."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return path.as_uri()
    return str(path)
