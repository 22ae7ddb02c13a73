"""report.png: right numbers, and a sound picture of every kind of run."""

import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import msgspec
import numpy as np
import pytest
from PIL import Image

from kantor_fleet.execution.in_process_team import team
from kantor_fleet.report.history import RunHistory, Trail
from kantor_fleet.report.report import draw
from kantor_fleet.report.style import team_colours
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import Observation, Outputs, Pose, State
from kantor_protocol.scenario.load import parse
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent, Record, StepRecord
from kantor_worldsim.world.world import StepVerdict, WorldSetup

MISSION = """
name = "small"

[domain]
min_m = [0.0, 0.0]
max_m = [200.0, 100.0]

[robots]
count = 2

[starts]
random = true

[energy]
points = 60

[radio]
range_m = 60.0

[samples]
count = 20

[targets]
count = 15

[[density]]
mean_m = [50.0, 50.0]
variance_m2 = [400.0, 400.0]

[[density]]
mean_m = [150.0, 50.0]
variance_m2 = [400.0, 400.0]
"""
CENTRALIZED = ("coordination=centralized", "merge=min", "claims=false")

Cut = Callable[[list[Record]], list[Record]]


def play(*overrides: str, seed: int = 1) -> list[Record]:
    """The whole record of a small mission with `key.sub=value` overrides."""
    scenario = parse(MISSION, "small", overrides)
    setup = WorldSetup.of(scenario, seed)
    records: list[Record] = []
    simulation = Simulation(scenario, seed, setup, [records.append])
    exchange = InProcessExchange(team(scenario, seed, setup))
    simulate(simulation, exchange, seed, lambda: False, exchange)
    return records


def followed(records: list[Record]) -> RunHistory:
    """The history of a run."""
    run = RunHistory.of(records)
    assert run is not None
    return run


def picture(records: list[Record], path: Path) -> Image.Image:
    """The drawn report, opened. A warning while drawing is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw(records, path)
    with Image.open(path) as image:
        image.load()
        return image


def in_one_point(records: list[Record]) -> list[Record]:
    """The opening with all samples, targets and robots in the same place."""
    opening = records[0]
    assert isinstance(opening, Opening)
    arrays = (opening.samples_m, opening.targets_m, opening.starts_m)
    samples_m, targets_m, starts_m = (
        msgspec.structs.replace(array, content=np.full(array.shape, 7.0).tobytes())
        for array in arrays
    )
    return [
        msgspec.structs.replace(
            opening, samples_m=samples_m, targets_m=targets_m, starts_m=starts_m
        )
    ]


def garbled(records: list[Record]) -> list[Record]:
    """The record with packed pairs that cannot be read."""

    def garble(step_record: StepRecord) -> StepRecord:
        assert step_record.outputs is not None
        outputs = msgspec.structs.replace(step_record.outputs, lowered=b"\xff", spent=b"\xff")
        return msgspec.structs.replace(step_record, outputs=outputs)

    return [
        msgspec.structs.replace(record, step_records=tuple(map(garble, record.step_records)))
        if isinstance(record, Batch)
        else record
        for record in records
    ]


def whole(records: list[Record]) -> list[Record]:
    """The record as it is."""
    return records


def without_ending(records: list[Record]) -> list[Record]:
    """A record cut while the mission ran."""
    return records[: len(records) // 2]


def opening_alone(records: list[Record]) -> list[Record]:
    """A record cut before any step."""
    return records[:1]


def without_steps(records: list[Record]) -> list[Record]:
    """A record in which every robot is absent from every batch."""
    silent = (
        Batch(record.now_ns, (), (), 0, ("r1", "r2"))
        for record in records
        if isinstance(record, Batch)
    )
    return [records[0], *silent, records[-1]]


CASES: dict[str, tuple[tuple[str, ...], Cut]] = {
    "decentralized": ((), whole),
    "centralized": (CENTRALIZED, whole),
    "supervisor of finite range": ((*CENTRALIZED, "supervisor.range_m=50.0"), whole),
    "no radio at all": (("radio.range_m=0.0", "limit_s=1.0"), whole),
    "radio without a range": (("radio.range_m=inf",), whole),
    "radio wider than the map": (("radio.range_m=5000.0",), whole),
    "everything walks": (("samples.diffusion_m=3.0", "targets.diffusion_m=3.0"), whole),
    "no targets": (("targets.count=0",), whole),
    "one robot": (("robots.count=1",), whole),
    "one sample": (("samples.count=1",), whole),
    "one of everything": (
        ("robots.count=1", "samples.count=1", "energy.points=1", "targets.count=1"),
        whole,
    ),
    "ten robots": (("robots.count=10", "limit_s=2.0"), whole),
    "hundred robots": (("robots.count=100", "energy.points=200", "limit_s=0.5"), whole),
    "all in one point": ((), in_one_point),
    "no ending": ((), without_ending),
    "no batches": ((), opening_alone),
    "no robot ever steps": ((), without_steps),
    "unreadable pairs": ((), garbled),
    "longest name": ((f"name={'long-name-' * 6}abcd",), opening_alone),
    "narrow domain far from the origin": (
        ("domain.min_m=[5000000.0, 0.0]", "domain.max_m=[5000900.0, 1.0]"),
        opening_alone,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_every_run_has_a_picture(case: str, tmp_path: Path) -> None:
    """Whatever a run was, and wherever its record stops, its report is a PNG of 14 x 8 inches."""
    overrides, cut = CASES[case]

    image = picture(cut(play(*overrides)), tmp_path / "report.png")

    assert (image.format, image.size) == ("PNG", (1540, 880))
    assert np.unique(np.asarray(image.convert("L"))).size > 10  # something is on it


def test_record_without_an_opening_has_no_picture(tmp_path: Path) -> None:
    """A mission that was given up while waiting for robots leaves nothing to draw."""
    draw([], tmp_path / "report.png")
    draw([Ending(0, "interrupted")], tmp_path / "report.png")

    assert list(tmp_path.iterdir()) == []


def test_records_are_read_once_in_order(tmp_path: Path) -> None:
    """A journal is read from disk as it is drawn: an iterator is enough."""
    draw(iter(play()), tmp_path / "report.png")

    assert (tmp_path / "report.png").exists()


def test_same_record_gives_the_same_picture(tmp_path: Path) -> None:
    """There is no time of day and no chance in it; the layout's solver may differ in rounding."""
    records = play()
    first, second = (
        np.asarray(picture(records, tmp_path / name), dtype=np.int64) for name in ("1.png", "2.png")
    )

    assert np.abs(first - second).max() <= 8


def test_drawing_leaves_matplotlib_as_it_was(tmp_path: Path) -> None:
    """The report has its own style and does not change matplotlib's."""
    before = dict(mpl.rcParams)

    draw(play(), tmp_path / "report.png")

    assert dict(mpl.rcParams) == before


def test_drawing_needs_no_display(tmp_path: Path) -> None:
    """Reports are drawn on servers, and beside a program that draws: pyplot stays out."""
    code = (
        "import sys; from pathlib import Path; from kantor_fleet.report.report import draw; "
        "from kantor_worldsim.record.records import decode_record; "
        "draw([decode_record(Path(sys.argv[1]).read_bytes())], Path(sys.argv[2])); "
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    (tmp_path / "opening").write_bytes(msgspec.msgpack.encode(play()[0]))
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"}

    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "opening", tmp_path / "report.png"],
        env=environment,
        check=False,
    )

    assert done.returncode == 0


@pytest.mark.parametrize(
    "overrides",
    [
        ("merge=min", "claims=false"),
        ("merge=ledger",),
        CENTRALIZED,
        ("coordination=centralized", "merge=ledger"),
        ("planner=spectral",),
    ],
)
@pytest.mark.parametrize("limit_s", [0.5, 2.0, 10.0])
def test_map_and_diagram_agree_on_what_is_left(overrides: tuple[str, ...], limit_s: float) -> None:
    """The weights on the map add up to the mass left that the metrics end with."""
    run = followed(play(*overrides, f"limit_s={limit_s}"))

    assert run.share_left.mean() == pytest.approx(run.metrics.rows[-1].mass_left, abs=1e-12)
    assert run.share_left.min() >= 0.0
    assert run.share_left.max() <= 1.0


def test_targets_walk_as_in_the_world() -> None:
    """The picture moves targets by itself: where one was just found, the picture has it, too."""
    records = play("targets.diffusion_m=3.0", "sensor.range_m=20.0")
    finds = followed(records).metrics.finds
    last_s, _, target, x_m, y_m = finds[-1]
    until = [r for r in records if not isinstance(r, Batch) or r.now_ns * 1e-9 <= last_s]

    run = followed(until[:-1])  # without the ending, which comes later

    assert last_s > 0.0
    walked_m = run.walked(run.setup.targets_m, 3.0, Purpose.TARGET_WALK)
    assert walked_m[target].tolist() == [x_m, y_m]
    assert walked_m[target].tolist() != run.setup.targets_m[target].tolist()


def step_record(
    name: str, now_s: float, state: State, *, heard: bool = False, x_m: float = 1.0
) -> StepRecord:
    """A step of one robot, at a place on the x axis."""
    pose = Pose(x_m, 0.0)
    return StepRecord(
        name=name,
        now_ns=round(now_s * 1e9),
        observation=Observation(0, pose),
        heard=(("r9", 1),) if heard else (),
        outputs=Outputs(step=round(now_s * 10), pose=pose, state=state),
        verdict=StepVerdict(pose),
    )


def test_moments_are_in_time_not_in_steps() -> None:
    """Clocks differ: contact and finish are marked when they happened, the finish at the last one."""
    opening = play()[0]
    exploring, finished = State.EXPLORING, State.FINISHED
    batches = [
        Batch(
            100_000_000,
            (step_record("r1", 0.1, exploring), step_record("r2", 0.1, exploring)),
            (),
            0,
        ),
        Batch(300_000_000, (step_record("r1", 0.3, finished),), (), 0),
        Batch(700_000_000, (step_record("r2", 0.7, finished, heard=True),), (), 0),
        Batch(
            900_000_000,
            (step_record("r1", 0.9, finished, heard=True), step_record("r2", 0.9, finished)),
            (),
            0,
        ),
    ]

    assert followed([opening, *batches[:2]]).contact_s is None
    assert followed([opening, *batches[:2]]).finish_s is None
    assert followed([opening, *batches]).contact_s == pytest.approx(0.7)
    assert followed([opening, *batches]).finish_s == pytest.approx(0.7)


STRUCK = (
    "coordination=centralized",
    (
        "faults=[{kind='kill', who=['r2'], from_s=1.0, until_s=1.9, disk='lost'},"
        "{kind='kill', who=['supervisor'], from_s=1.5}, {kind='pause', who=['worldsim'], from_s=2.4,"
        "until_s=2.9}, {kind='late', who=['r1'], until_s=0.4},"
        "{kind='partition', shape='halves', from_s=0.5, until_s=1000.0}]"
    ),
)


def test_outages_are_the_times_in_which_processes_were_down() -> None:
    """From the event that stopped a process to the one that resumed it; and the place of a robot's death."""
    records = play(*STRUCK)
    run = followed(records)
    where = next(
        step_record.verdict.pose
        for record in reversed(records)
        for step_record in (
            record.step_records if isinstance(record, Batch) and record.now_ns < 10**9 else ()
        )
        if step_record.name == "r2" and step_record.verdict
    )

    assert [
        (who, cause, round(from_s, 6), until_s and round(until_s, 6))
        for who, cause, from_s, until_s in run.outages
    ] == [
        ("r1", "late", 0.0, 0.4),
        ("r2", "kill", 1.0, 1.9),
        ("worldsim", "pause", 2.4, 2.9),
        ("supervisor", "kill", 1.5, None),
    ]
    assert run.deaths_m == [(where.x_m, where.y_m)]


def test_outages_and_cuts_are_drawn(tmp_path: Path) -> None:
    """The picture of a run under faults is not that of the same run with them left out."""
    records = play(*STRUCK)
    calm = [record for record in records if not isinstance(record, ProcessEvent)]

    assert picture(records, tmp_path / "struck.png") != picture(calm, tmp_path / "calm.png")


def test_very_long_record_is_drawn(tmp_path: Path) -> None:
    """Ten thousand steps back and forth, one measurement each, are no problem to draw."""
    opening = play("robots.count=1", "metrics.every=1")[0]
    steps = range(1, 10_001)
    batches = (
        Batch(
            step * 100_000_000,
            (step_record("r1", step / 10, State.EXPLORING, x_m=100.0 * (step % 2)),),
            (),
            0,
        )
        for step in steps
    )

    image = picture([opening, *batches], tmp_path / "report.png")

    assert image.size == (1540, 880)


def test_trail_keeps_what_can_be_seen() -> None:
    """However many steps a robot makes, its trail has a point for each grain that it moved."""
    trail = Trail(0.0, 0.0, grain_m=1.0)
    for step in range(1, 100_001):
        trail.extend(step / 10_000.0, 0.0)

    assert trail.xy_m[:, 0].tolist() == pytest.approx([*range(11), 10.0])
    assert trail.end_m == (10.0, 0.0)


@pytest.mark.parametrize("robots", [1, 2, 5, 10, 11, 50, 100])
def test_every_robot_has_its_own_colour(robots: int) -> None:
    """No two robots of up to a hundred look alike."""
    assert len(set(team_colours(robots))) == robots
