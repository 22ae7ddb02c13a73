"""Bad TOML trees, made of the trees of good scenarios."""

import functools
import random
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from fuzz import corpora
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.load import parse


class Trees:
    """TOML trees with values and keys replaced, as msgpack."""

    def __init__(self) -> None:
        self._trees = [to_tree(parse(text, "good")) for text in corpora.texts_of_scenarios()]
        self._values: list[Any] = [
            *(0, 1, -1, 2, 3, 1000, 2**62, 2**64 - 1, 0.0, -0.5, 0.5, 1e-9, 1e300, True, False),
            *(float("nan"), float("inf"), -float("inf"), "", "r1", "r9", "supervisor", "worldsim"),
            *("min", "ledger", "turn", "dubins", "a.csv", "c.txt", "kill", "drop", "é\n", [], {}),
            *([[0.0, 0.0]], [1.0, 2.0], ["r1"], ["r1", "r1"], ["r9"], [{}], [[]], [None], None),
            *({"name": "spectral"}, {"kind": "kill", "who": ["r2"], "from_s": 1.0, "until_s": 1.5}),
            *(
                {"kind": "late", "who": ["r1", "r2"], "until_s": 2.0},
                {"kind": "impostor", "who": ["r1"]},
            ),
        ]
        names = {key for tree in self._trees for key in _keys_in(tree)}
        self._keys = sorted(names | {"x", "", "kind", "until_s", "a\nb", "mapp", "probabilty"})

    def batch(self, name: object, count: int) -> list[bytes]:
        """Return `count` inputs; the same ones for the same name."""
        draw = random.Random(str(name))
        return [self._one(draw.random) for _ in range(count)]

    def _one(self, draw: Callable[[], float]) -> bytes:
        tree = msgspec.msgpack.decode(self._packed(int(draw() * len(self._trees))))
        for _ in range(1 if draw() < 0.6 else 3):
            self._change(tree, draw)
        return msgspec.msgpack.encode(tree)

    @functools.cache  # noqa: B019  there is one of it
    def _packed(self, i: int) -> bytes:
        return msgspec.msgpack.encode(self._trees[i])

    def _change(self, tree: Any, draw: Callable[[], float]) -> None:
        """Replace a value, add or remove a key, or repeat a row."""
        while True:
            among = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
            if not among:
                return
            key = among[int(draw() * len(among))]
            if isinstance(tree[key], dict | list) and draw() < 0.75 and tree[key]:
                tree = tree[key]
                continue
            break
        chance = draw()
        value = self._values[int(draw() * len(self._values))]
        if isinstance(value, dict | list):
            value = msgspec.msgpack.decode(msgspec.msgpack.encode(value))
        if chance < 0.55:
            tree[key] = value
        elif chance < 0.7:
            del tree[key]
        elif isinstance(tree, dict):
            tree[self._keys[int(draw() * len(self._keys))]] = value if chance < 0.9 else tree[key]
        else:
            tree.append(tree[key] if chance < 0.85 else value)


def _keys_in(tree: Any) -> Iterable[str]:
    for key, value in tree.items() if isinstance(tree, dict) else ():
        yield key
        yield from _keys_in(value)
    for value in tree if isinstance(tree, list) else ():
        yield from _keys_in(value)
