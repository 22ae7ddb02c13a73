"""TOML that costs a parser more than its length is refused before it is parsed."""

import tomllib
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.files.toml import TomlError, parse_toml
from support.strategies import examples

BEYOND_REASON = {
    "dotted-key": ".".join(["a"] * 30_000) + " = 1",
    "dotted-key-with-spaces": " . ".join(["a"] * 30_000) + " = 1",
    "dotted-key-in-quotes": ".".join(['"a b"'] * 10_000) + " = 1",
    "dotted-key-in-a-table": "x = {" + ".".join(["a"] * 30_000) + " = 1}",
    "deep-tables": "\n".join(f"[{'.'.join(['a'] * 200)}.b{i}]" for i in range(4000)),
    "arrays": "a = " + "[" * 20_000 + "]" * 20_000,
    "tables": "a = " + "{b = " * 20_000 + "1" + "}" * 20_000,
    "number-of-5000-digits": "a = " + "9" * 5000,
}


@pytest.mark.parametrize("name", BEYOND_REASON)
def test_toml_beyond_reason_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(TomlError) as caught:
        parse_toml(BEYOND_REASON[name])

    assert "\n" not in str(caught.value)


@examples(200)
@given(
    text=st.text(st.sampled_from("ab.[]{}=\"' \n1,"), max_size=60)
    | st.lists(st.sampled_from(["a", ".", "=", "1", '"', "[", "]", "\n"]), max_size=40).map("".join)
)
def test_short_toml_is_read_as_by_tomllib(text: str) -> None:
    """The guard refuses nothing that a person writes."""
    expected = None
    with suppress(ValueError):
        expected = tomllib.loads(text)
    read = None
    with suppress(TomlError):
        read = parse_toml(text)

    assert read == expected


def test_long_texts_and_many_keys_are_no_long_keys() -> None:
    """Dots in a text, in numbers and on many lines."""
    tree = parse_toml('a = "one. two. three."\nb = [' + "1.5, " * 500 + "]\n" + "[c]\nd.e = 1\n")

    assert tree["c"] == {"d": {"e": 1}}
    assert len(tree["b"]) == 500
