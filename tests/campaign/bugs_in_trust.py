"""Bugs in what is believed: signatures, proofs, forks, energy of others; and bounds that only hostile input meets.

Those that no participant of a mission meets, not even a liar, are caught by a test of the suite instead.
"""

import functools
import os
import tempfile
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from campaign.planting import Patch, Touches, mutant, replace_kernel, wrap
from fleet.test_verify_hostile import test_a_folder_is_locked_once
from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.machine import State
from kantor_protocol.node.signing import Signing
from kantor_protocol.replication import gossip, proofs
from kantor_protocol.replication.attested import Attested
from kantor_protocol.replication.parts import Part, entries_of
from kantor_protocol.replication.proofs import ProvenSuffix, Rules
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import OFFERED, UNITS_MAX
from kantor_protocol.scenario.faults.liars import Lie, liars_of
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.rate_limit import TokenBucket
from kantor_protocol.wire import weights
from kantor_protocol.wire.attestations import HASH_BYTES, Attestation
from kantor_worldsim.exchange import admission_kernels
from kantor_worldsim.exchange.admission_kernels import POSSIBLE
from kantor_worldsim.record.run_folder import FolderLock
from protocol.replication.test_attested import (
    test_a_false_word_of_another_is_refused_whole,
    test_all_incarnations_together_have_one_budget,
)
from protocol.transport.test_rate_limit import test_work_beyond_the_quota_is_refused
from protocol.wire.test_weights import test_no_more_is_inflated_than_there_can_be
from worldsim.exchange.test_admission import test_what_cannot_be_is_refused


def signed(scenario: Scenario) -> bool:
    """Missions in which only what is signed counts."""
    return scenario.signed


def tells(*lies: Lie) -> Touches:
    """Missions with such a liar."""
    return lambda scenario: bool(liars_of(scenario.faults, *lies))


# What others say.


@mutant("a signature is not looked at", tells("rewrite"))
def signature_unchecked(patch: Patch) -> None:
    patch.setattr(proofs, "is_attested", lambda *_: True)


@mutant("an attestation counts that another participant has signed", tells("rewrite"))
def any_key_will_do(patch: Patch) -> None:
    def make(is_sound: Any) -> Any:
        def sound(rules: Rules, covered: int, attestation: Attestation) -> bool:
            return any(
                is_sound(rules._replace(keys=(key,) * len(rules.keys)), covered, attestation)
                for key in rules.keys
            )

        return sound

    wrap(patch, proofs, "is_sound", make)


@mutant(
    "the entries of a suffix are not compared with what is attested",
    test=partial(test_a_false_word_of_another_is_refused_whole, "another-first-hash"),
)
def proof_not_compared(patch: Patch) -> None:
    def make(read: Any) -> Any:
        def unproven(
            rules: Rules, logs: bytes, part: Part, attestation: Attestation, proof: bytes
        ) -> ProvenSuffix | None:
            entries = entries_of(logs, part, rules.config.bound, rules.config.value_max)
            found: ProvenSuffix | None = read(rules, logs, part, attestation, proof)
            if found is not None or entries is None:
                return found
            return ProvenSuffix(part, entries, proof[:HASH_BYTES])

        return unproven

    wrap(patch, proofs, "_read_suffix", make)


@mutant("two stories of one origin are no fork", tells("fork"))
def fork_ignored(patch: Patch) -> None:
    patch.setattr(Attested, "_contradicts", lambda *_: False)
    patch.setattr(Attested, "_differs", lambda *_: False)


@mutant(
    "another may ship more than its energy", test=test_all_incarnations_together_have_one_budget
)
def energy_of_others_without_bound(patch: Patch) -> None:
    patch.setattr(gossip, "spend_max", lambda *_: UNITS_MAX)


@mutant("a robot that finds a liar out takes the mission for finished", tells("fork"))
def gives_up_beside_a_liar(patch: Patch) -> None:
    def make(state: Any) -> Any:
        return property(lambda self: State.FINISHED if self._gossip.forked else state.fget(self))

    wrap(patch, DensityRobot, "_state", make)


# What is said of oneself, and passed on.


@mutant("nobody signs its attestations", signed)
def nothing_is_signed(patch: Patch) -> None:
    patch.setattr(Signing, "step", lambda self, inputs: self.machine.step(inputs))


@mutant("all that is held is passed on as soon as some of it is attested", signed)
def more_is_passed_on_than_attested(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Replica, target: int = -1) -> tuple[bytes, bytes, bytes]:
            if self.config.proving:
                offered = self.store.sending[OFFERED]
                offered[:] = np.where(offered > 0, self.store.length, offered)
            parts: tuple[bytes, bytes, bytes] = compose(self, target)
            return parts

        return composed

    wrap(patch, Replica, "compose", make)


@mutant("what is passed on of others comes without its attestation", signed)
def attestations_of_others_left_out(patch: Patch) -> None:
    def make(attest: Any) -> Any:
        def attested(self: Attested, replica: Replica, *arguments: Any, **named: Any) -> Any:
            message = attest(self, replica, *arguments, **named)
            own = tuple(i for i in message.attestations if i.origin == replica.config.me)
            return msgspec.structs.replace(message, proofs=(), attestations=own)

        return attested

    wrap(patch, Attested, "attest", make)


# Bounds that only hostile input meets.


def _any_version_vector(
    written: np.ndarray,
    stamps: np.ndarray,
    settings: np.ndarray,
    version_vector: bytes,
    own: int,
    own_length: int,
    step: int,
) -> int:
    return POSSIBLE


def _never_ahead(reached: np.ndarray, origin: int, stamp: int, own: int, step: int) -> bool:
    return False


@functools.wraps(test_a_folder_is_locked_once)
def _in_a_folder() -> None:
    with tempfile.TemporaryDirectory() as folder:
        test_a_folder_is_locked_once(Path(folder))


@mutant(
    "world-sim does not compare how long a log is said to be",
    test=partial(test_what_cannot_be_is_refused, "holds-what-was-never-written"),
)
def admission_without_lengths(patch: Patch) -> None:
    replace_kernel(patch, admission_kernels, "_check_version_vector", _any_version_vector)


@mutant(
    "world-sim does not compare stamps with what their origins have reached",
    test=partial(test_what_cannot_be_is_refused, "claim-from-the-future"),
)
def admission_without_stamps(patch: Patch) -> None:
    replace_kernel(patch, admission_kernels, "_is_ahead", _never_ahead)


@mutant(
    "a keyframe is inflated whatever comes of it", test=test_no_more_is_inflated_than_there_can_be
)
def inflates_without_bound(patch: Patch) -> None:
    def make(from_keyframe: Any) -> Any:
        def inflated(content: bytes, size: int) -> Any:
            return from_keyframe(zlib.compress(zlib.decompress(content)), size)

        return inflated

    wrap(patch, weights, "_from_keyframe", make)


@mutant("a run folder is not locked", test=_in_a_folder)
def run_folder_not_locked(patch: Patch) -> None:
    def made(self: FolderLock, folder: Path) -> None:
        self._descriptor = os.open(folder, os.O_RDONLY)

    patch.setattr(FolderLock, "__init__", made)


@mutant("the work that a report causes is not charged", test=test_work_beyond_the_quota_is_refused)
def work_not_charged(patch: Patch) -> None:
    patch.setattr(TokenBucket, "charge", lambda *_: True)
