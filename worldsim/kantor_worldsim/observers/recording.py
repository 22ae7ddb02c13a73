"""The recording of a run: journal, metrics and checker in a declared order, and the files of the run folder."""

import secrets
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.rate_limit import Excess
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.metrics.mapping import MapMetrics
from kantor_worldsim.observers.metrics.result import RefusedReports, Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.columnar import DecodedRecord
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
from kantor_worldsim.world.inputs import inputs_of


def metrics_of(
    scenario: Scenario,
    exact_every: int | None = None,
    on_row: Callable[[Any], None] = lambda _row: None,
) -> RunMetrics:
    """Metrics for a scenario: of a density, or of a map. exact_every: see DensityMetrics.

    on_row: called with each row when it is complete.
    """
    return MapMetrics(on_row) if scenario.mapping else DensityMetrics(exact_every, on_row)


class Recording:
    """Records a run: its pipeline of observers, and the run folder if there is one.

    The order of the observers: first the journal, so that nothing is measured that is not on record; then metrics,
    whose rows go to the journal, the checker and `metrics.csv`; then the checker, which on a map reads the map
    tracker that metrics keep.
    """

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
        """folder: an existing folder for the run's files; None keeps nothing. exact_every: see DensityMetrics.

        speed: realtime, simulated seconds in a real one. past: records of this run that the folder has already.
        """
        self.refused_at_door = 0
        """Messages that world-sim refused; set by the process that hosts the bus."""
        self.excess: dict[ParticipantId, Excess] = {}
        """Messages beyond each participant's quota; set likewise."""
        self.refused_reports: dict[ParticipantId, RefusedReports] = {}
        """Unsound reports of each participant that sent any; set likewise."""
        self.silences: dict[ParticipantId, int] = {}
        """How often each participant did not answer in time; set likewise."""
        self.run = secrets.token_hex(8) if past is None else past.terms.run
        """Names the run."""
        self._scenario = scenario
        self._seed = seed
        self._exchange = exchange
        self._folder = folder
        self._monotonic = monotonic
        self._started = monotonic()
        self.metrics = metrics_of(scenario, exact_every, self._distribute)
        self.metrics.keeps_rows = folder is None  # otherwise they are in its files
        tracker = self.metrics.map_tracker if isinstance(self.metrics, MapMetrics) else None
        self.checker = Checker(tracker, virtual=exchange != "wall")
        self._table = self._open_folder(folder, exact_every, speed, past)
        self.journal = Journal(None if folder is None else folder / JOURNAL, anew=past is not None)
        self._pipeline = Pipeline(self.journal, self.metrics, self.checker)
        if past is not None:
            self._catch_up(past.records)

    def _open_folder(
        self, folder: Path | None, exact_every: int | None, speed: float, past: Past | None
    ) -> MetricsFile | None:
        """Write the files that a run folder has from the start."""
        if folder is None:
            return None
        if past is not None:
            self._manifest = past.manifest | {"resumed": past.terms.resumed + 1}
        else:
            write_text(folder / SCENARIO, to_toml(self._scenario))
            self._manifest = new_manifest(self._scenario, self._seed, self._exchange)
            self._manifest |= {"run": self.run, "speed": speed, "exact_every": exact_every}
            self._manifest["inputs"] = msgspec.to_builtins(inputs_of(self._scenario))
        write_json(folder / MANIFEST, self._manifest)
        return MetricsFile(folder / METRICS, self.metrics.columns)

    def _catch_up(self, records: Iterable[Record]) -> None:
        """Observe the records of the past. The old journal stays until the new one has all of them."""
        for record in records:
            self.observe(record)
        self.journal.replace()

    def observe(self, record: Record) -> DecodedRecord:
        """Record one record; decoded, for further observers."""
        return self._pipeline.observe(record)

    def _distribute(self, row: Any) -> None:
        """Pass on a row of metrics."""
        self.journal.append_row(row)
        self.checker.observe_row(row)
        if self._table is not None:
            self._table.add(row)

    def finish(self) -> Result:
        """Close the files, sum up, and write `result.json`."""
        self.journal.close()
        if self._table is not None:
            self._table.close()
        result = self.metrics.result(
            exchange=self._exchange,
            digest=self.journal.digest.hex,
            wall_s=self._monotonic() - self._started,
            refused_at_door=self.refused_at_door,
            excess=self.excess,
            refused_reports=self.refused_reports,
            silences=self.silences,
            record=self.journal.cut or "whole",
            complaints=tuple(self.checker.violations),
            lies=self.checker.lies,
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
