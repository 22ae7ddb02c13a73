"""The folder that a run leaves (design, part 7), and the referees that follow the run."""

import secrets
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.rate_limit import Excess
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.mapping import MapMetrics
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.record.columnar import ColumnarDecoder
from kantor_worldsim.record.journal import Journal, file_digest
from kantor_worldsim.record.records import Record
from kantor_worldsim.record.run_folder import (
    JOURNAL,
    MANIFEST,
    METRICS,
    RESULT,
    SCENARIO,
    MetricsFile,
    Past,
    new_manifest,
    write_json,
    write_text,
)


def metrics_of(
    scenario: Scenario,
    exact_every: int | None = None,
    decoder: ColumnarDecoder | None = None,
    map_tracker: MapTracker | None = None,
) -> RunMetrics:
    """What follows a run of a scenario: what a density needs, or a map. exact_every: see Metrics.

    decoder, map_tracker: those that other referees of the same run follow it by.
    """
    if scenario.mapping:
        return MapMetrics(decoder, map_tracker)
    return DensityMetrics(exact_every, decoder)


class Recording:
    """Follows a run: journal, metrics and checker; writes the run folder if there is one."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        exchange: str,
        folder: Path | None = None,
        exact_every: int | None = None,
        monotonic: Callable[[], float] = time.monotonic,
        speed: float = 1.0,
        past: Past | None = None,
    ) -> None:
        """folder: an existing folder for the run's files; None keeps nothing. exact_every: see Metrics.

        speed: wall, simulated seconds in a real one. past: what the folder has of this run already.
        """
        self._decoder = ColumnarDecoder()
        map_tracker = MapTracker(self._decoder) if scenario.mapping else None
        self.metrics = metrics_of(scenario, exact_every, self._decoder, map_tracker)
        self.checker = Checker(self._decoder, map_tracker, virtual=exchange != "wall")
        self.payload = b""
        """The last record, encoded."""
        self.refused_at_door = 0
        """Messages to world-sim that it could not take in; whoever runs the bus counts them."""
        self.excess: dict[ParticipantId, Excess] = {}
        """What it did not listen to, by participant; likewise."""
        self._scenario = scenario
        self._seed = seed
        self._exchange = exchange
        self._folder = folder
        self._monotonic = monotonic
        self._started = monotonic()
        self._rows = 0
        self._table: MetricsFile | None = None
        self.run = secrets.token_hex(8) if past is None else past.terms.run
        """Names the run."""
        if folder is not None and past is not None:
            resumed = past.manifest.get("resumed", 0) + 1
            self._manifest = past.manifest | {"resumed": resumed}
        elif folder is not None:
            write_text(folder / SCENARIO, to_toml(scenario))
            self._manifest = new_manifest(scenario, seed, exchange)
            self._manifest |= {"run": self.run, "speed": speed, "exact_every": exact_every}
        if folder is not None:
            write_json(folder / MANIFEST, self._manifest)
            self._table = MetricsFile(folder / METRICS, self.metrics.columns)
        self.journal = Journal(None if folder is None else folder / JOURNAL, anew=past is not None)
        if past is not None:
            self._follow(past.records)

    def _follow(self, records: Iterable[Record]) -> None:
        """Catch up. The old journal is there until all of it is in the new one."""
        for record in records:
            self.observe(record)
        self.journal.replace()

    def observe(self, record: Record) -> None:
        """Follow one record."""
        self.payload = self._decoder.read(record)[0]
        self.journal.append(record, self.payload)
        self.metrics.observe(record)
        self.checker.observe(record)
        if len(self.metrics.rows) > self._rows:
            self._write_rows()

    def _write_rows(self) -> None:
        for row in self.metrics.rows[self._rows :]:
            self.journal.append_row(row)
            self.checker.observe_row(row)
            if self._table is not None:
                self._table.add(row)
        self._rows = len(self.metrics.rows)

    def finish(self) -> Result:
        """Close the files and sum up."""
        self.journal.close()
        if self._table is not None:
            self._table.close()
        result = self.metrics.result(
            exchange=self._exchange,
            digest=self.journal.digest.hex,
            wall_s=self._monotonic() - self._started,
            refused_at_door=self.refused_at_door,
            excess=self.excess,
            record=self.journal.cut or "whole",
            complaints=tuple(self.checker.violations),
        )
        if self._folder is not None:
            self._manifest |= {
                "digest": result.digest,
                "records": self.journal.digest.records,
                "record": result.record,
                "ended": result.ended,
                "absences": result.absences,
                "journal_blake2b": file_digest(self._folder / JOURNAL),
            }
            write_json(self._folder / MANIFEST, self._manifest)
            write_text(
                self._folder / RESULT,
                msgspec.json.format(msgspec.json.encode(result), indent=2).decode() + "\n",
            )
        return result
