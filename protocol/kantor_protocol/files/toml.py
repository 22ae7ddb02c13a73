"""TOML under a guard: a text that would cost a parser more than its length is refused before it is parsed."""

import re
import tomllib
from typing import Any

from kantor_protocol.files.reading import TOO_DEEP, is_deep

_KEY_PARTS_MAX = 32
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w\"'-]){_PART}(?:\.[ \t]*+{_PART}){{{_KEY_PARTS_MAX}}}")
"""tomllib takes time in the square of the parts of a dotted key."""


class TomlError(ValueError):
    """A text that is no TOML, or none that is read; the message is one line without the place of the text."""


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text. Raises TomlError."""
    if is_deep(text):
        raise TomlError(f"{TOO_DEEP}; write it flatter")
    if _LONG_KEY.search(text):
        raise TomlError(f"a key of more than {_KEY_PARTS_MAX} parts; write it flatter")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise TomlError(" ".join(str(error).split())) from None
