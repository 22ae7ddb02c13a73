"""The end of a run: draws its picture, prints a summary, and gives the exit code."""

import csv
import sys
from pathlib import Path

import msgspec

from kantor_fleet.exits import Exit
from kantor_protocol.files.reading import read_bytes
from kantor_worldsim.observers.metrics.result import MapResult, Result
from kantor_worldsim.record.journal import read
from kantor_worldsim.record.run_folder import JOURNAL, METRICS, REPORT, RESULT

_RESULT_BYTES_MAX = 1 << 24


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
    """Times (s) and exact distances (m) in a run folder; they take long and are not computed again."""
    with (folder / METRICS).open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get("w1_exact")]
    return [(float(row["time_s"]), float(row["w1_exact"])) for row in rows]


def read_result(folder: Path) -> Result | None:
    """The result of a run folder, if it has one."""
    try:
        return msgspec.json.decode(read_bytes(folder / RESULT, _RESULT_BYTES_MAX), type=Result)
    except (ValueError, msgspec.MsgspecError, RecursionError):
        return None


def exit_code_of(result: Result) -> Exit:
    """The exit code of a result: DONE if the mission was met without a violation."""
    met = result.ended == "done" and result.violations == 0
    return Exit.DONE if met else Exit.NOT_MET


def summary(result: Result) -> str:
    """A summary of a few lines."""
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
        *([_detected(result)] if result.map is None else _of_map(result, result.map)),
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
    """A line for the effects of each fault, and one for restarts."""
    lines = []
    for name, counts in result.faults.items():
        by_effect = msgspec.structs.asdict(counts).items()
        effects = [f"{n} {effect.replace('_', ' ')}" for effect, n in by_effect if n]
        if not name.endswith(" byzantine"):  # its effects are lies
            lines.append(f"  fault {name:<16} {', '.join(effects) or 'no effect'}")
    if result.lies:
        told = ", ".join(f"{name} {times}" for name, times in result.lies.items())
        lines.append(f"  lies      {told}: found by the rules, and no violations")
    if result.restarts:
        back = f"{_counted(result.restarts, 'restart')}, {_counted(result.incarnations, 'new incarnation')}"
        if (rejoin := result.rejoin_s) is not None:
            back += f"; back to a step in {rejoin.median_s:.2f} s, at most {rejoin.max_s:.2f} s"
        lines.append(f"  back      {back}")
    return lines


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _detected(result: Result) -> str:
    found = f"{result.detected}/{result.targets} targets"
    if result.detection_rate is not None:
        found += f" ({100.0 * result.detection_rate:.1f} %)"
    return f"  detected  {found}"


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
    found = [_detected(result)] if result.targets else []
    unseen = (
        f"{map_.unseen} free cells that robots could reach; "
        f"{_counted(map_.frontiers_left, 'cell')} from which they could go on"
    )
    lines = [f"  explored  {explored}", f"  distance  {distance}", f"  8 regions {even}"]
    return [*lines, *([f"  unseen    {unseen}"] if map_.unseen else []), *found]
