"""Invariants: participants and world-sim validate their own state while a mission of a campaign runs."""

from collections.abc import Callable, Mapping

from kantor_protocol.base.machine import ParticipantId

EVERY_RECORDS = 50
"""Records from one validation to the next; each walks through all that a participant holds."""


class Invariants:
    """Calls `validate` of the parts of a mission that have it, and collects what it finds."""

    def __init__(self) -> None:
        self.violations: list[str] = []
        self._validate: dict[ParticipantId, Callable[[], None]] = {}
        self._records = 0

    def watch(self, parts: Mapping[ParticipantId, object]) -> None:
        """Validate these parts from now on, by the names of their processes."""
        for name, part in parts.items():
            validate = getattr(part, "validate", None)
            if callable(validate):
                self._validate[name] = validate

    def count(self, now_ns: int) -> None:
        """Count a record, and validate all parts if it is time."""
        self._records += 1
        if self._records % EVERY_RECORDS:
            return
        for name, validate in self._validate.items():
            try:
                validate()
            except AssertionError as error:
                what = str(error).partition("\n")[0] or "its state contradicts itself"
                self.violations.append(f"invariant: t={now_ns * 1e-9:.3f} s: {name}: {what}")
