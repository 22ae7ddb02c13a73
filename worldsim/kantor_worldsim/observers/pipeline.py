"""The pipeline of observers: each record is encoded and decoded once, and passed on in a declared order."""

from typing import Protocol

from kantor_worldsim.record.columnar import ColumnarDecoder, DecodedRecord
from kantor_worldsim.record.records import Record


class RecordObserver(Protocol):
    """An observer of the records of one run."""

    def observe(self, decoded: DecodedRecord, /) -> None:
        """Follow one record. The first is the opening."""
        ...


class Pipeline:
    """Observers of one run, called in the order in which they are given.

    An observer may rely on every observer before it having followed the same record, and on none after it.
    """

    def __init__(self, *observers: RecordObserver) -> None:
        self._observers = observers
        self._decoder = ColumnarDecoder()

    def observe(self, record: Record, payload: bytes = b"") -> DecodedRecord:
        """Decode a record for all observers, and pass it to each. payload: the record encoded, if it came so."""
        decoded = self._decoder.decode(record, payload)
        for observer in self._observers:
            observer.observe(decoded)
        return decoded
