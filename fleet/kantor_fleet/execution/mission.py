"""`kantor run`: a mission from start to picture."""

import csv
import sys
import time
from pathlib import Path

import msgspec

from kantor_fleet.cli.exits import Exit, warn
from kantor_fleet.cli.interrupts import Interrupts
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.processes.local import FleetConfig, local_fleet, watch_progress
from kantor_fleet.processes.preload import warm_up
from kantor_fleet.report.progress import ProgressView
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.session import BusError
from kantor_worldsim.observers.metrics.result import MapResult, Result
from kantor_worldsim.observers.progress import progress
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.journal import read
from kantor_worldsim.record.records import Record
from kantor_worldsim.record.run_folder import JOURNAL, METRICS, REPORT, RESULT, folder_for
from kantor_worldsim.world.world import WorldSetup

_GLANCE_S = 0.2


def run(
    scenario: Scenario, seed: int, exchange: str, speed: float, out: Path, exact_every: int | None
) -> Exit:
    """Run a mission and leave its folder; what to exit with. Raises ScenarioError, BusError, OSError.

    exact_every: see Metrics.
    """
    site = WorldSetup.of(scenario, seed)
    warn(site.warnings)
    folder = folder_for(scenario, seed, out)
    with Interrupts() as interrupts:
        if exchange == "in-process":
            recording = Recording(scenario, seed, exchange, folder, exact_every)
            code = _run_in_process(scenario, seed, site, recording, interrupts)
        else:
            order = FleetConfig(scenario, seed, exchange, speed, folder, exact_every)
            code = _run_processes(order, interrupts)
        conclude(folder)
        return interrupts.code or code


def conclude(folder: Path) -> None:
    """Draw the report and print the summary of a run folder."""
    from kantor_fleet.report.report import draw  # noqa: PLC0415  matplotlib is slow to import

    try:
        draw((record for _, record in read(folder / JOURNAL)), folder / REPORT, _exact_of(folder))
    except OSError as error:
        print(f"kantor: no {REPORT}: {error}", file=sys.stderr)
    result = read_result(folder)
    if result is not None:
        print(summary(result))
    print(f"  {folder}/  ({', '.join(sorted(path.name for path in folder.iterdir()))})")


def _exact_of(folder: Path) -> list[tuple[float, float]]:
    """Times (s) and exact distances (m) in a run folder; they take long, so they are not redone."""
    with (folder / METRICS).open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get("w1_exact")]
    return [(float(row["time_s"]), float(row["w1_exact"])) for row in rows]


def read_result(folder: Path) -> Result | None:
    """The result of a run folder, if it has one."""
    try:
        return msgspec.json.decode((folder / RESULT).read_bytes(), type=Result)
    except (OSError, msgspec.MsgspecError):
        return None


def verdict(result: Result) -> Exit:
    """What a result means as an exit code."""
    met = result.ended == "done" and result.violations == 0
    return Exit.DONE if met else Exit.NOT_MET


def summary(result: Result) -> str:
    """A few lines for a person."""
    finished = "-" if result.finished_tick is None else f"tick {result.finished_tick}"
    wire = result.bytes_per_robot_tick
    rules = "all rules held" if not result.violations else f"{result.violations} VIOLATIONS"
    own_part = f"{wire.weights:.1f} B weights"
    if result.map is not None:
        own_part = f"{result.map.log_bytes_per_robot_tick:.1f} B of maps"
    radio = (
        f"{result.deliveries} deliveries, {result.drops} dropped, "
        f"{result.out_of_range_refused} out of range; "
        f"{own_part}, {wire.total:.1f} B in all a robot and tick"
    )
    lines = [
        f"{result.scenario} (seed {result.seed}, {result.exchange}): {result.ended}",
        *(_of_density(result) if result.map is None else _of_map(result, result.map)),
        f"  finished  {finished}; {result.ticks} ticks, {result.wall_s:.1f} s",
        *(_of_mass(result) if result.map is None else ()),
        f"  radio     {radio}",
        *_of_faults(result),
        f"  checker   {rules}; record {result.record}",
        *(f"            {complaint}" for complaint in result.complaints),
        f"  digest    {result.digest}",
    ]
    return "\n".join(lines)


def _of_faults(result: Result) -> list[str]:
    """What each fault did, in a line of its own, and who came back."""
    lines = []
    for name, counts in result.faults.items():
        told = msgspec.structs.asdict(counts).items()
        deeds = [f"{n} {deed.replace('_', ' ')}" for deed, n in told if n]
        lines.append(f"  fault {name:<16} {', '.join(deeds) or 'never struck'}")
    if result.restarts:
        back = f"{_counted(result.restarts, 'restart')}, {_counted(result.incarnations, 'new incarnation')}"
        if (rejoin := result.rejoin_s) is not None:
            back += f"; back to a step in {rejoin.median_s:.2f} s, at most {rejoin.max_s:.2f} s"
        lines.append(f"  back      {back}")
    return lines


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _found(result: Result) -> str:
    found = f"{result.detected}/{result.targets} targets"
    if result.detection_rate is not None:
        found += f" ({100.0 * result.detection_rate:.1f} %)"
    return f"  detected  {found}"


def _of_density(result: Result) -> list[str]:
    return [_found(result)]


def _of_mass(result: Result) -> list[str]:
    tight = "-" if result.w_ub.tight is None else f"{result.w_ub.tight:.4g}"
    energy = (
        f"{result.energy_spent}/{result.energy_total} points, "
        f"{100.0 * result.mass_left:.2f} % of the mass left, "
        f"{100.0 * result.mass_double_counted:.2f} % counted twice"
    )
    exact = "" if result.w1_exact is None else f", exact {result.w1_exact:.4g}"
    bound = (
        f"{result.w_ub_start:.4g} -> {result.w_ub.paper:.4g} "
        f"(tight {tight}{exact}, last tick's {result.w_ub.final_instant:.4g})"
    )
    return [f"  energy    {energy}", f"  W_UB      {bound}"]


def _of_map(result: Result, map_: MapResult) -> list[str]:
    def tick(value: int | None) -> str:
        return "-" if value is None else f"{value}"

    explored = (
        f"{100.0 * map_.explored:.1f} %; 95 % at tick {tick(map_.t95_tick)}, "
        f"99 % at {tick(map_.t99_tick)}, known to all at {tick(map_.all_t99_tick)}, "
        f"complete at {tick(map_.completed_tick)}"
    )
    distance = (
        f"{map_.distance_m:.0f} m, {map_.longest_m:.0f} m by one; "
        f"overlap {100.0 * map_.overlap:.0f} %, {map_.bumps} bumps, {map_.switches} switches"
    )
    even = f"WTV {map_.wtv_mean.r8:.4g} (final {map_.wtv_final.r8:.4g}), EPV {map_.epv_mean.r8:.4g}"
    found = [_found(result)] if result.targets else []
    lines = [f"  explored  {explored}", f"  distance  {distance}", f"  8 regions {even}"]
    return [*lines, *found]


def _run_in_process(
    scenario: Scenario, seed: int, site: WorldSetup, recording: Recording, interrupts: Interrupts
) -> Exit:
    with ProgressView(scenario.name) as view:
        warm_up()
        glanced = time.monotonic()

        def glance(_record: Record) -> None:
            nonlocal glanced
            if time.monotonic() - glanced >= _GLANCE_S:
                glanced = time.monotonic()
                view.show(progress(recording.metrics, scenario, "running", ""))

        reason = play(scenario, seed, site, [recording.take, glance], stopped=interrupts)
        view.show(progress(recording.metrics, scenario, "over", reason))
    return verdict(recording.finish())


def _run_processes(order: FleetConfig, interrupts: Interrupts) -> Exit:
    with ProgressView(order.scenario.name) as view:
        view.note("starting the fleet (the first time, kernels are compiled: about half a minute)")
        warm_up()
        if interrupts():
            return Exit.INTERRUPTED
        with local_fleet(order) as fleet:
            asked = False
            try:
                for message in watch_progress(fleet):
                    if message is not None:
                        view.show(message)
                    for name, failure in fleet.newly_failed():
                        view.note(f"{name} ended with {_told(failure)}; the others go on")
                    if (ended := fleet.revive()) is not None:
                        view.note(f"world-sim ended with {ended}; it goes on from its record")
                    waiting = message is not None and message.phase == "waiting"
                    if not asked and (interrupts() or (waiting and fleet.deserted)):
                        asked = True
                        view.note("ending the mission")
                        fleet.stop()
            except BusError:
                view.note(f"world-sim is not there; see {order.folder / 'logs' / 'worldsim.log'}")
            fleet.disband()
            code = fleet.world_sim.exitcode
            failed = fleet.any_failed
    result = read_result(order.folder)
    if code or result is None:
        return Exit(code) if code in set(Exit) else Exit.PROCESS_FAILED
    return Exit.PROCESS_FAILED if failed else verdict(result)


def _told(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
