"""Whole participants that receive envelopes, and their recovery from write-ahead logs."""

import zlib
from collections.abc import Callable
from pathlib import Path

from fuzz import corpora
from fuzz.decoding import Decode, refuses
from fuzz.mutations import unframe
from kantor_fleet.execution.in_process_team import participant
from kantor_protocol.base.machine import Body, Envelope, Inputs, Observation, Pose, StateMachine
from kantor_protocol.node import wal as wal_module
from kantor_protocol.node.recovery import RecoverableNode, WalContents
from kantor_protocol.node.wal import WalFile
from kantor_protocol.wire.messages import RefusedError, check_outputs, decode_inputs


def _new_participant(me: str, played: corpora.Played) -> StateMachine:
    scenario, setup = played.scenario, played.setup
    return participant(me, scenario, 1, setup, Body(setup.poses(scenario)[me]))


def stepping(name: str, me: str) -> Callable[[Path], Decode]:
    """A whole participant receives an envelope in each step."""

    def start(_folder: Path) -> Decode:
        played = corpora.played(name)
        machine = _new_participant(me, played)
        pose, step, refused = Pose(1.5, 1.5), 0, 0
        inputs = [i for i, name in zip(played.inputs, played.names, strict=True) if name == me]
        scan = inputs[0].observation.scan

        def take(content: bytes) -> bool:
            nonlocal pose, step, refused
            other = "r2" if me != "r2" else "r1"
            inbox = (Envelope(other, step, "", content),)
            observation = Observation(step, pose, (), scan)
            outputs = machine.step(Inputs(step * played.scenario.period_ns, observation, inbox))
            check_outputs(outputs)
            taken = outputs.refused == refused
            assert refused <= outputs.refused <= refused + 1
            pose, step, refused = outputs.pose, outputs.step, outputs.refused
            return taken

        return take

    return start


class _OneEntryLog:
    """A write-ahead log of one entry."""

    def __init__(self, entry: bytes) -> None:
        self._entry = entry

    def read(self) -> WalContents:
        """Return the entry."""
        return WalContents(Body(Pose(10.0, 10.0)), (self._entry,))

    def reset(self, initial_state: Body) -> None:
        """Fail: nothing is written here."""
        raise AssertionError("a log that covers all is thrown away")

    def append(self, inputs: bytes) -> None:
        """Drop the entry."""


def recovering(name: str, me: str) -> Callable[[Path], Decode]:
    """A node recovers from an entry that was tampered with."""

    def start(_folder: Path) -> Decode:
        played = corpora.played(name)
        machine = _new_participant(me, played)

        def recover(content: bytes) -> None:
            RecoverableNode(lambda _body: machine, _OneEntryLog(content), Body(Pose(10.0, 10.0)))

        return refuses(RefusedError, recover)

    return start


def wal(folder: Path, *, framed: bool) -> Decode:
    """A write-ahead log on disk: its sound beginning is read, and every entry can be stepped through.

    framed: length and checksum of every frame are right, whatever is in it.
    """
    path = folder / "wal"

    def read(content: bytes) -> bool:
        path.write_bytes(_in_frames(unframe(content)) if framed else content)
        wal = WalFile(path, "run")
        try:
            entries = wal.read()
        finally:
            wal.close()
        for entry in entries.inputs if entries else ():
            decode_inputs(entry)
        return entries is not None

    return read


def _in_frames(parts: tuple[bytes, ...]) -> bytes:
    content, crc = wal_module._MAGIC, zlib.crc32(wal_module._MAGIC)
    for part in parts[:-1]:
        frame, crc = wal_module._frame(part, crc)
        content += frame
    return content + parts[-1]
