"""Every decoder meets thousands of bad inputs; `fuzz.py` gives each a million."""

import os
import re
import time
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from fuzz import fuzz
from fuzz.decoding import Corpus, Decode, Target
from fuzz.mutations import LEB_TOKENS, MSGPACK_TOKENS, leb, msgpack_spans, number_spans
from fuzz.targets import TARGETS
from kantor_protocol.wire.messages import encode

BATCH = 500
SEED = 20

SLOW = {
    *("scenario-text", "scenario-tree", "override", "chaos-file", "credentials", "wal-file"),
    *("runs-of-sweep", "map-nav2", "map-movingai", "map-pgm", "map-png", "map-tiff"),
    *("points-csv", "points-npy", "points-image", "mapper", "allocation", "journal"),
    *("scenario-file", "toml", "manifest", "inputs-of-map", "points-tiff"),
    *("indexed-journal", "opening", "manifest-of-a-run", "result"),
}
"""Tens of microseconds for an input, or hundreds."""


@pytest.mark.parametrize("name", TARGETS)
def test_bad_input_is_refused_and_changes_nothing(name: str, tmp_path: Path) -> None:
    """No exception but the documented one; what a target asserts itself; both outcomes are seen."""
    target, batches = TARGETS[name], 4 if name in SLOW else 30
    corpus = target.inputs()
    taken = sum(_one_batch(target, corpus, f"{name} {SEED} {i}", tmp_path) for i in range(batches))

    assert 0 < taken < batches * BATCH


def _one_batch(target: Target, corpus: Corpus, batch: str, folder: Path) -> int:
    decode, taken = target.start(folder), 0
    for i, content in enumerate(corpus.batch(batch, BATCH)):
        try:
            taken += decode(content)
        except Exception as error:
            name, seed, number = batch.split()
            options = f"--only {name} --seed {seed} --batch {number} --inputs {i + 1}"
            raise AssertionError(f"python tests/fuzz/fuzz.py {options}: {content!r}") from error
    return taken


def test_inputs_are_the_same_for_the_same_name() -> None:
    corpus = TARGETS["learn-ledger"].inputs()

    assert corpus.batch("a", 50) == TARGETS["learn-ledger"].inputs().batch("a", 50)
    assert corpus.batch("a", 50) != corpus.batch("b", 50)


def test_spans_are_whole_values() -> None:
    values = [1, "r1", leb(300) + leb(5), [2.5, None], {"a": b""}, -7, 2**40, "x" * 40]
    content = encode(values)
    spans = msgpack_spans(content)

    assert spans[-1] == (0, len(content))
    assert {content[low:high] for low, high in spans} >= {*map(encode, values), leb(300), leb(5)}


def test_spans_of_numbers_are_adjacent() -> None:
    content = leb(1) + leb(2**40) + leb(128) + leb(0)
    spans = number_spans(content)

    assert [content[low:high] for low, high in spans] == [leb(1), leb(2**40), leb(128), leb(0)]
    assert all(one[1] == other[0] for one, other in pairwise(spans))


def test_tokens_differ() -> None:
    """Or some come more often than others."""
    assert len(set(LEB_TOKENS)) == len(LEB_TOKENS)
    assert len(set(MSGPACK_TOKENS)) > 0.8 * len(MSGPACK_TOKENS)


# The command.


def test_a_decoder_that_breaks_the_rule_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The input as a file, the command that repeats it, exit code 1; also when the process dies."""

    def dies(_folder: Path) -> Decode:
        return lambda content: os._exit(9) if len(content) > 300 else True

    def raises(_folder: Path) -> Decode:
        return lambda content: bool(1 // (len(content) <= 300))

    for name, start in (("news", dies), ("inputs", raises)):
        monkeypatch.setitem(TARGETS, name, TARGETS[name]._replace(start=start))
    arguments = ["fuzz.py", "--only", "news", "inputs", "--inputs", "1000", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)

    assert fuzz.main() == 1
    told = capfd.readouterr().out
    assert "the process died: exit code 9" in told
    assert "ZeroDivisionError" in told
    assert len(re.findall(r"python tests/fuzz/fuzz.py --only \w+ --seed 0 --batch \d+", told)) == 2
    assert all(len(path.read_bytes()) > 300 for path in tmp_path.iterdir() if path.suffix != ".txt")


def test_a_decoder_that_keeps_memory_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """No single input is to blame: the command repeats them all."""
    kept: list[bytes] = []

    def leaks(_folder: Path) -> Decode:
        return lambda content: not kept.append(b"x" * (4000 + len(content)))

    monkeypatch.setitem(TARGETS, "news", TARGETS["news"]._replace(start=leaks))
    arguments = ["fuzz.py", "--only", "news", "--inputs", "22000", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)

    assert fuzz.main() == 1
    told = capfd.readouterr().out
    assert re.search(r"FAIL \d+ MiB more than before", told)
    assert "--only news --seed 0 --batch 0 --inputs 22000" in told
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("costs", ["time", "memory"])
def test_an_input_that_costs_too_much_is_reported(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    costs: str,
) -> None:
    """Time of the CPU, or memory at its peak, although the decoder refuses it in the end."""

    def takes_time() -> None:
        end_s = time.process_time() + 0.2
        while time.process_time() < end_s:
            pass

    def takes_memory() -> None:
        assert len(b"x" * (64 << 20)) == 64 << 20

    def wastes(_folder: Path) -> Decode:
        take = takes_time if costs == "time" else takes_memory
        return lambda content: len(content) <= 300 or bool(take())

    monkeypatch.setattr(fuzz, "INPUT_CPU_S", 0.1)
    monkeypatch.setattr(fuzz, "INPUT_BYTES", 32 << 20)
    monkeypatch.setitem(TARGETS, "news", TARGETS["news"]._replace(start=wastes))
    arguments = ["fuzz.py", "--only", "news", "--inputs", "1000", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)

    assert fuzz.main() == 1
    unit = " s" if costs == "time" else " MiB"
    assert re.search(
        rf"FAIL LimitError: [\d.]+{unit} for an input of \d+ bytes", capfd.readouterr().out
    )


def grown_bytes(pipe: Connection) -> None:
    """How much more is held after large pictures have come and gone."""
    before = fuzz.held_bytes()
    for mib in (30, 29, 28):
        assert len(b"x" * (mib << 20)) == mib << 20
    pipe.send(fuzz.held_bytes() - before)


def test_freed_memory_is_no_growth() -> None:
    """However large it was, and wherever malloc had it; in a process where nothing else is."""
    context = get_context("spawn")
    told, telling = context.Pipe(duplex=False)
    process = context.Process(target=grown_bytes, args=(telling,))
    process.start()
    telling.close()

    assert told.recv() < 4 << 20
    process.join()


def test_a_sound_decoder_is_tallied(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["fuzz.py", "--only", "array", "--inputs", "1200"])

    assert fuzz.main() == 0
    assert re.search(r"array +1200 +\d+ +\d+ +\d+ ", capfd.readouterr().out)
