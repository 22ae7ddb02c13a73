"""Every replica that a test of replication builds is validated when the test is over."""

from collections.abc import Iterator

import pytest

from kantor_protocol.replication.registers import Registers
from support.replication import replicas


@pytest.fixture(autouse=True)
def built_replicas_are_valid(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The invariants of replicas, and of registers that are tested alone."""
    built: list[Registers] = []
    build = Registers.__init__

    def build_and_note(self: Registers, *arguments: object, **named: object) -> None:
        build(self, *arguments, **named)
        built.append(self)

    monkeypatch.setattr(Registers, "__init__", build_and_note)
    with replicas.validating():
        yield
    for registers in built:
        registers.validate()
