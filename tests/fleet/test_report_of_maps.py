"""report.png of missions on a map: sound for every kind of run, and true to the record."""

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from kantor_fleet.report.history import RunHistory
from kantor_fleet.report.map_drawing import draw_bumps, draw_known
from kantor_fleet.report.report import draw
from kantor_fleet.report.summary import summary
from kantor_protocol.base.grid import Frame
from kantor_worldsim.observers.metrics.mapping import MapMetrics
from kantor_worldsim.record.records import Batch, Record, opening_of
from kantor_worldsim.world.maps import Ground
from support.grounds import drawn
from support.missions import ROOMS, explored, on_map, setup_of

Records = Sequence[Record]
TEN = "[" + ", ".join(f"[{1.5 + x}, {1.5 + y}]" for x in range(5) for y in range(2)) + "]"


def picture(records: Records, path: Path) -> Image.Image:
    draw(records, path)
    with Image.open(path) as image:
        image.load()
        return image


def followed(records: Records) -> tuple[RunHistory, MapMetrics]:
    run = RunHistory.of(records)
    assert run is not None
    assert isinstance(run.metrics, MapMetrics)
    return run, run.metrics


def with_bumps(records: Records) -> Records:
    """The records with all moves of r1 ended by walls."""

    def bumped(batch: Batch) -> Batch:
        first, *others = batch.step_records
        verdict = msgspec.structs.replace(first.verdict, bumped=True)
        return msgspec.structs.replace(
            batch, step_records=(msgspec.structs.replace(first, verdict=verdict), *others)
        )

    return [bumped(record) if isinstance(record, Batch) else record for record in records]


CASES: dict[str, tuple[tuple[str, ...], Callable[[Records], Records]]] = {
    "decentralized": ((), lambda records: records),
    "centralized": (("coordination=centralized",), lambda records: records),
    "supervisor in its place": (
        ("coordination=centralized", "supervisor.pose_m=[8.5, 3.5]", "supervisor.range_m=12"),
        lambda records: records,
    ),
    "one robot": (("robots.count=1", "starts.poses_m=[[1.5, 1.5]]"), lambda records: records),
    "ten robots": (("robots.count=10", f"starts.poses_m={TEN}"), lambda records: records),
    "no radio": (("radio.range_m=0",), lambda records: records),
    "bumps": ((), with_bumps),
    "no ending": ((), lambda records: records[:-1]),
    "cut early": ((), lambda records: records[:4]),
    "opening alone": ((), lambda records: records[:1]),
    "row for every tick": (("metrics.every=1",), lambda records: records),
}


@pytest.mark.parametrize("case", CASES)
def test_every_run_has_a_picture(case: str, tmp_path: Path) -> None:
    """Whatever a run was, and wherever its record stops, its report is a PNG of 14 x 8 inches."""
    overrides, cut = CASES[case]

    image = picture(cut(explored(*overrides)), tmp_path / "report.png")

    assert (image.format, image.size) == ("PNG", (1540, 880))
    assert np.unique(np.asarray(image.convert("L"))).size > 10


@pytest.mark.parametrize(
    "ground",
    [
        drawn("."),
        drawn("....................", resolution_m=0.05, origin_m=(1e5, -1e5)),
        Ground(Frame(1.0, (0.0, 0.0), 3, 5000), np.ones((3, 5000), dtype=np.uint8)),
        Ground(
            Frame(0.1, (0.0, 0.0), 500, 500),
            1 + (np.indices((500, 500)).sum(axis=0) % 2).astype(np.uint8),
        ),
    ],
    ids=["one cell", "far from the origin", "very wide", "chequered"],
)
def test_any_map_has_a_picture(ground: Ground, tmp_path: Path) -> None:
    """One that is small, large, narrow, or nothing but edges."""
    start = ground.frame.centre_of(0)
    scenario = on_map("robots.count=1", f"starts.poses_m=[{list(start)}]")
    opening = opening_of(scenario, 1, setup_of(scenario, ground), {"r1": ()})

    assert picture([opening], tmp_path / "report.png").size == (1540, 880)


def test_colours_are_those_of_the_stamps() -> None:
    """The colour of a cell shows when it was first seen; walls are darker, unseen cells are pale."""
    run, exploration = followed(explored()[:12])
    axes = Figure().subplots()
    draw_known(axes, exploration.map_tracker, 0.1)
    (image,) = axes.images
    colours = np.asarray(image.get_array())
    ticks = exploration.map_tracker.state.first_tick.reshape(ROOMS.cells.shape)
    free = ROOMS.cells == 1

    assert run.setup.ground is not None
    assert image.get_extent() == list(ROOMS.frame.extent_m)
    assert (colours[free & (ticks < 0)] == 255).all()
    assert np.unique(colours[~free & (ticks < 0)]).size == 1
    for kind in (free, ~free):
        by_tick = {
            tick: {tuple(colour) for colour in colours[kind & (ticks == tick)].tolist()}
            for tick in np.unique(ticks[kind & (ticks >= 0)]).tolist()
        }
        assert all(len(found) == 1 for found in by_tick.values())
        assert len(set.union(*by_tick.values())) == len(by_tick)


def test_outlines_are_the_borders_of_what_is_free() -> None:
    """Every side of a cell between free and not free, once."""
    _, exploration = followed(explored())
    axes = Figure().subplots()
    draw_known(axes, exploration.map_tracker, 0.1)
    (outlines,) = [made for made in axes.collections if isinstance(made, LineCollection)]
    free = np.pad(ROOMS.cells == 1, 1)

    assert len(outlines.get_segments()) == (
        (free[1:] != free[:-1]).sum() + (free[:, 1:] != free[:, :-1]).sum()
    )


def test_bumps_stand_where_they_happened() -> None:
    """A mark for each."""
    _, exploration = followed(with_bumps(explored()))
    axes = Figure().subplots()
    draw_bumps(axes, exploration.map_tracker)
    (marks,) = axes.collections

    assert marks.get_offsets().tolist() == [list(xy) for xy in exploration.map_tracker.bumps]
    assert len(exploration.map_tracker.bumps) > 10


def test_summary_of_a_map_has_shares_ticks_and_metres() -> None:
    """It has no energy and no bounds."""
    _, exploration = followed(explored())
    result = exploration.result(
        exchange="in-process", digest="d", wall_s=1.0, record="whole", complaints=()
    )
    assert result.map is not None
    lines = summary(result).splitlines()

    assert lines[0] == "rooms (seed 1, in-process): done"
    assert lines[1].startswith(f"  explored  100.0 %; 95 % at tick {result.map.t95_tick}, ")
    assert lines[1].endswith(f"complete at {result.map.completed_tick}")
    assert lines[2].startswith(f"  distance  {result.map.distance_m:.0f} m, ")
    assert lines[3].startswith("  8 regions WTV ")
    assert f"{result.map.log_bytes_per_robot_tick:.1f} B of maps" in summary(result)
    assert not any("W_UB" in line or "energy" in line or "detected" in line for line in lines)


def test_summary_of_a_cut_run_has_dashes_for_missing_ticks() -> None:
    """What did not happen has no tick."""
    _, exploration = followed(explored()[:4])
    result = exploration.result(exchange="-", digest="", wall_s=0.0, record="whole", complaints=())

    assert "99 % at -, known to all at -, complete at -" in summary(result)
