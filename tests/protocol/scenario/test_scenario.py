"""Scenarios: read from TOML, checked once, refused in one line that names the key and the remedy."""

import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import SUPERVISOR
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.dump import to_toml, to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import from_tree, load, parse
from kantor_protocol.scenario.schema import PlannerOptions, Scenario
from kantor_protocol.scenario.validate import is_image
from kantor_protocol.wire.weights import Units
from support.strategies import (
    SMALL,
    TOML_KEYS,
    TOML_TREES,
    TOML_VALUES,
    TomlTree,
    examples,
    mission,
    paths_of,
    planted,
)

PACKAGED = {
    Path(str(entry)).stem: entry.read_text(encoding="utf-8")
    for entry in files("kantor_fleet").joinpath("scenarios").iterdir()
    if str(entry).endswith(".toml")
}
"""Every scenario in the package, as text."""


def refusal(make: Callable[[], Any]) -> str:
    """What a ScenarioError says; it is one line that is not empty."""
    with pytest.raises(ScenarioError) as caught:
        make()
    message = str(caught.value)

    assert message.strip()
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize("name", PACKAGED)
def test_packaged_scenario_is_sound(name: str) -> None:
    """What is in the package parses, and its file has its name and a summary."""
    scenario = parse(PACKAGED[name], name)

    assert scenario.name == name
    assert scenario.summary


@pytest.mark.parametrize(
    ("name", "units", "steps", "centralized", "order", "merge"),
    [
        ("paper-centralized", Units(10_000, 5, 2), 1000, True, "turn", "min"),
        ("paper-centralized-concurrent", Units(10_000, 5, 2), 1000, True, "concurrent", "min"),
        ("paper-decentralized", Units(6_000, 5, 3), 2000, False, "turn", "min"),
        ("paper-timevarying", Units(2_000, 2, 1), 1000, True, "turn", "min"),
        ("paper-timeinvariant", Units(2_000, 2, 1), 1000, True, "turn", "min"),
        ("paper-single", Units(10_000, 5, 2), 5000, False, "concurrent", "min"),
    ],
)
def test_papers_missions_have_the_papers_numbers(
    *, name: str, units: Units, steps: int, centralized: bool, order: str, merge: str
) -> None:
    """Kabir & Lee, section VI: M, N and t_e of each figure (eq. 7: t_e = M / n_a)."""
    scenario = parse(PACKAGED[name], name)

    assert Units.of(scenario.energy.points, scenario.samples.count or 0) == units
    assert scenario.steps_per_robot == steps
    assert scenario.centralized == centralized
    assert (scenario.clock.order, scenario.merge, scenario.claims) == (order, merge, False)
    assert scenario.vehicle.speed_m_s * scenario.clock.period_s == 10.0


OVERRIDES = (
    (),
    ("radio.range_m=inf", "supervisor.range_m=12.5", "supervisor.pose_m=[1, 2]", "limit_s=1e3"),
    ("clock.drift_ppm=250.0", "clock.jitter_s=1e-3", "publish.keyframe_every=3"),
    ('summary="a \\"quoted\\" line\\nand \\u007f another\\\\"', "claims=false"),
    ("starts.random=true", "starts.poses_m=[]", "targets.file='t.csv'", "planner.horizon=12"),
    (
        "supervisor.pose_m=[-1.5e-7, 2e22]",
        "coordination=centralized",
        "limit_s=1e4",
        "energy.steps=7",
    ),
)


@pytest.mark.parametrize("overrides", OVERRIDES)
@pytest.mark.parametrize("name", PACKAGED)
def test_written_scenario_reads_as_the_same_one(name: str, overrides: tuple[str, ...]) -> None:
    """`to_toml` and `parse` are inverse to each other."""
    scenario = parse(PACKAGED[name], name, overrides)

    assert parse(to_toml(scenario), "written") == scenario
    assert from_tree(to_tree(scenario), "tree") == scenario


@examples(60)
@given(summary=st.text(), range_m=st.floats(min_value=0.0), x_m=st.floats(0.0, 100.0))
def test_written_values_read_as_the_same_ones(summary: str, range_m: float, x_m: float) -> None:
    """Any text and any number survive, to the last bit."""
    scenario = msgspec.structs.replace(
        mission(),
        summary=summary,
        radio=msgspec.structs.replace(mission().radio, range_m=range_m),
        starts=msgspec.structs.replace(mission().starts, poses_m=((x_m, x_m),) * 3),
    )

    assert parse(to_toml(scenario), "written") == scenario


REFUSED = {
    "misspelt-key": ("planner.horizn=3", "planner.horizn", "did you mean horizon?"),
    "misspelt-table": ("planer.horizon=3", "planer", "did you mean planner?"),
    "unknown-key": ("radio.xyz=3", "radio.xyz", "known: range_m, drop, delay_s"),
    "text-for-a-number": ("robots.count='three'", "robots.count", "expected `int`, got `str`"),
    "number-for-a-table": ("radio=3", "radio", "expected `object`, got `int`"),
    "number-for-a-switch": ("claims=1", "claims", "expected `bool`"),
    "three-coordinates": ("domain.min_m=[0.0, 0.0, 0.0]", "domain.min_m", "length 2"),
    "negative-radio-range": ("radio.range_m=-1.0", "radio.range_m", ">= 0.0"),
    "negative-sensor-range": ("sensor.range_m=-15.0", "sensor.range_m", "> 0.0"),
    "no-robots": ("robots.count=0", "robots.count", ">= 1"),
    "too-many-robots": ("robots.count=1001", "robots.count", "<= 1000"),
    "no-samples": ("samples.count=0", "samples.count", ">= 1"),
    "no-energy": ("energy.points=0", "energy", "set it"),
    "too-little-energy": ("energy.points=2", "energy.points", "at least one point for each"),
    "certain-loss": ("radio.drop=1.0", "radio.drop", "< 1.0"),
    "horizon-of-13": ("planner.horizon=13", "planner.horizon", "<= 12"),
    "no-modes": ("planner.modes=0", "planner.modes", ">= 1"),
    "65-modes": ("planner.modes=65", "planner.modes", "<= 64"),
    "unknown-planner": ("planner.name=oracle", "planner.name", "transport, spectral"),
    "unknown-planner-in-short": ("planner=oracle", "planner.name", "transport, spectral"),
    "unknown-vehicle-in-short": ("vehicle=boat", "vehicle.name", "dubins"),
    "unknown-vehicle": ("vehicle.name=boat", "vehicle.name", "dubins"),
    "unknown-merge": ("merge=max", "merge", "min, ledger"),
    "unknown-coordination": ("coordination=both", "coordination", "centralized, decentralized"),
    "unknown-order": ("clock.order=random", "clock.order", "concurrent, turn"),
    "unknown-beacon": ("radio.beacon=light", "radio.beacon", "versions, state"),
    "start-outside": (
        "starts.poses_m=[[1.0, 1.0], [50.0, 100.5], [2.0, 2.0]]",
        "starts.poses_m[1]",
        "move it inside [0, 100] x [0, 100]",
    ),
    "too-few-starts": ("starts.poses_m=[[1.0, 1.0]]", "starts.poses_m", "set starts.random=true"),
    "too-many-starts": ("robots.count=2", "starts.poses_m", "3 given for 2 robots"),
    "no-starts": ("starts.poses_m=[]", "starts.poses_m", "set starts.random=true"),
    "domain-upside-down": ("domain.max_m=[0.0, 50.0]", "domain", "min_m must lie below max_m"),
    "no-source": ("density=[]", "samples", "add [[density]] tables or set samples.file"),
    "unknown-file-kind": ("samples.file='points.doc'", "samples.file", ".csv"),
    "unknown-target-file-kind": ("targets.file='points'", "targets.file", ".npy"),
    "nan-speed": ("vehicle.speed_m_s=nan", "vehicle.speed_m_s", "> 0.0"),
    "nan-corner": ("domain.min_m=[nan, 0.0]", "domain.min_m[0]", "set a finite one"),
    "nan-start": (
        "starts.poses_m=[[1.0, 1.0], [1.0, nan], [2.0, 2.0]]",
        "starts.poses_m[1][1]",
        "set a finite one",
    ),
    "infinite-speed": ("vehicle.speed_m_s=inf", "vehicle.speed_m_s", "set a finite one"),
    "infinite-sensor": ("sensor.range_m=inf", "sensor.range_m", "set a finite one"),
    "nan-limit": ("limit_s=nan", "limit_s", ""),
    "limit-beyond-counting": ("limit_s=1e305", "limit_s", "<="),
    "delay-beyond-counting": ("radio.delay_s=1e305", "radio.delay_s", "<="),
    "jitter-of-a-period": ("clock.jitter_s=0.1", "clock.jitter_s", "below"),
    "jitter-beyond-counting": ("clock.jitter_s=1e305", "clock.jitter_s", "<="),
    "bad-name": ("name='Über'", "name", "regex"),
    "number-that-overflows": (f"vehicle.speed_m_s=1{'0' * 400}", "vehicle.speed_m_s", "range"),
    "number-of-5000-digits": (f"robots.count=1{'0' * 5000}", "robots.count", "expected `int`"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_value_is_refused_with_its_key_and_a_remedy(name: str) -> None:
    """One line: where it comes from, which key, what to do about it."""
    override, key, remedy = REFUSED[name]
    message = refusal(lambda: mission(override))

    assert message.startswith(f"small: {key}: ")
    assert remedy in message


def test_jitter_may_not_let_a_step_overtake_the_next() -> None:
    """With spread and drift the shortest period counts, and it is named."""
    slower = "clock.drift_ppm=100000.0"
    message = refusal(lambda: mission("clock.spread=0.5", slower, "clock.jitter_s=0.046"))

    assert "0.045 s" in message
    assert mission("clock.spread=0.5", slower, "clock.jitter_s=0.044").clock.jitter_s == 0.044


@pytest.mark.parametrize("override", ["robots.count", "=3", ".count=3", "robots.=3", ""])
def test_override_without_key_or_value_is_refused(override: str) -> None:
    """--set takes key.sub=value, and says so."""
    assert refusal(lambda: mission(override)) == f"--set {override}: write it as key.sub=value"


def test_override_below_a_value_is_refused() -> None:
    """A value has no keys in it."""
    message = refusal(lambda: mission("name.first=ada"))

    assert message == "--set name.first=ada: name is not a table"


def test_override_is_toml_or_plain_text() -> None:
    """Quotes may be left out around text; everything else is as in the file."""
    scenario = mission("merge=min", "claims=false", "radio.range_m=3", "summary='two words'")

    assert (scenario.merge, scenario.claims) == ("min", False)
    assert (scenario.radio.range_m, scenario.summary) == (3.0, "two words")


@pytest.mark.parametrize(
    "written", ["planner=spectral", "planner='spectral'", " planner = spectral"]
)
def test_a_name_alone_says_which_planner_or_vehicle(written: str) -> None:
    """A table that has a name may be set to it; what else is in the table stays."""
    scenario = mission("planner.horizon=5", written, "vehicle=dubins", "planner.modes=10")

    assert scenario.planner == PlannerOptions(name="spectral", horizon=5, modes=10)
    assert scenario.vehicle.name == "dubins"


def test_only_a_planner_that_heads_for_samples_claims_them() -> None:
    """Claims are on by default; with another planner they are without effect, on any mission."""
    assert mission().claiming
    assert not mission("claims=false").claiming
    assert not mission("planner=spectral", "claims=true").claiming


def test_register_is_as_wide_as_the_modes() -> None:
    """K x K sums; robots that plan by samples share none."""
    assert mission("planner=spectral", "planner.modes=10").register_width == 100
    assert mission("planner.modes=10").register_width == 0


@pytest.mark.parametrize("key", ["name", "domain", "robots", "energy"])
def test_missing_key_is_named(key: str) -> None:
    """What has no default must be set."""
    tree = to_tree(mission())
    del tree[key]

    assert refusal(lambda: from_tree(tree, "small")) == f"small: {key}: missing; set it"


def test_missing_file_is_named(tmp_path: Path) -> None:
    """A scenario that is not there: its name, and where to find others."""
    path = tmp_path / "absent.toml"

    assert refusal(lambda: load(path)) == (
        f"{path}: no such scenario file; `kantor scenarios` lists the packaged ones"
    )


@pytest.mark.parametrize("content", [b"\xff\xfe", b"name = ", b"a = 1\na = 2", b"[[[", b"\x00"])
def test_file_that_is_no_toml_is_named(tmp_path: Path, content: bytes) -> None:
    """Noise, a cut line, a key twice."""
    path = tmp_path / "noise.toml"
    path.write_bytes(content)

    assert refusal(lambda: load(path)).startswith(f"{path}: ")


def test_folder_is_no_scenario(tmp_path: Path) -> None:
    """A folder in place of a file."""
    assert refusal(lambda: load(tmp_path)).startswith(f"{tmp_path}: cannot be read")


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 50_000, "a = " + "1" * 5000, "a = " + "{b=" * 9999]
)
def test_toml_beyond_reason_is_refused(text: str) -> None:
    """Brackets without end and numbers of thousands of digits."""
    assert refusal(lambda: parse(text, "small")).startswith("small: not valid TOML")


def test_files_are_found_beside_the_scenario(tmp_path: Path) -> None:
    """A relative file name is relative to the scenario's folder."""
    path = tmp_path / "mine.toml"
    path.write_text(SMALL + "[targets]\nfile = 'targets.csv'\n")

    assert load(path).targets.file == str(tmp_path.resolve() / "targets.csv")
    assert load(path).samples.file is None


def test_absolute_file_is_left_alone(tmp_path: Path) -> None:
    """An absolute name is a name, in the file and in an override."""
    path = tmp_path / "mine.toml"
    path.write_text(SMALL + "[targets]\nfile = '/data/targets.csv'\n")
    scenario = load(path, ["samples.file='/data/points.npy'"])

    assert scenario.targets.file == "/data/targets.csv"
    assert scenario.samples.file == "/data/points.npy"


@pytest.mark.parametrize("name", ["a" * 300 + ".csv", "a\\u0000.csv"])
def test_name_that_no_file_can_have_is_refused(tmp_path: Path, name: str) -> None:
    """Too long for the file system, or with a zero byte."""
    path = tmp_path / "mine.toml"
    path.write_text(SMALL)

    assert "cannot be the name of a file" in refusal(lambda: load(path, [f'samples.file="{name}"']))


@pytest.mark.parametrize(
    ("name", "image"), [("a.png", True), ("a.JPEG", True), ("a.csv", False), ("png", False)]
)
def test_image_is_recognized_by_its_suffix(*, name: str, image: bool) -> None:
    """A grey-scale density, or a table of points."""
    assert is_image(name) == image


def test_roster_is_the_robots_and_then_the_supervisor() -> None:
    """The place in the roster is the number by which messages name an origin."""
    assert mission().roster == ("r1", "r2", "r3")
    assert mission("coordination=centralized").roster == ("r1", "r2", "r3", SUPERVISOR)


def test_budget_is_the_energy_shared_out() -> None:
    """Eq. 7: M = n_a t_e; it may be given instead."""
    assert mission().steps_per_robot == 10
    assert mission("energy.points=5").steps_per_robot == 1
    assert mission("energy.steps=25").steps_per_robot == 25


def test_mission_is_cut_after_half_as_long_again_as_its_energy() -> None:
    """The limit is in simulated nanoseconds; slow clocks get more."""
    assert mission().limit_ns == 16_500_000_000
    assert mission("clock.spread=0.5").limit_ns == 24_750_000_000
    assert mission("limit_s=2.5").limit_ns == 2_500_000_000


def test_supervisor_stands_in_the_middle_unless_placed() -> None:
    """Its place is in the scenario, like that of all others."""
    assert mission().supervisor_m == (50.0, 50.0)
    assert mission("supervisor.pose_m=[1.0, 2.0]").supervisor_m == (1.0, 2.0)


def survives(make: Callable[[], Scenario]) -> None:
    """Refused in one line, or a scenario that can be used and written."""
    scenario, refusal_text = None, ""
    try:
        scenario = make()
    except ScenarioError as error:
        refusal_text = str(error)

    if scenario is None:
        assert len(refusal_text.splitlines()) == 1
    else:
        assert parse(to_toml(scenario), "written") == scenario
        assert scenario.limit_ns > 0
        assert len(step_clocks(scenario, 1)) == len(scenario.roster)
        assert math.isfinite(sum(scenario.supervisor_m))


@examples(200)
@given(tree=TOML_TREES)
def test_any_tree_is_refused_or_a_scenario(tree: TomlTree) -> None:
    """Whatever TOML may hold: nothing but ScenarioError."""
    survives(lambda: from_tree(tree, "any"))


@examples(300)
@given(data=st.data(), value=TOML_VALUES)
def test_any_value_in_any_place_is_refused_or_a_scenario(data: st.DataObject, value: Any) -> None:
    """A sound scenario with one value replaced by anything: nothing but ScenarioError."""
    tree = to_tree(mission("limit_s=9.0", "energy.steps=5", "supervisor.pose_m=[1.0, 1.0]"))
    path = data.draw(st.sampled_from(paths_of(tree)))
    survives(lambda: from_tree(planted(tree, path, value), "any"))


@examples(100)
@given(table=st.sampled_from(sorted(to_tree(mission()))), key=TOML_KEYS, value=TOML_VALUES)
def test_any_key_in_any_table_is_refused_or_a_scenario(table: str, key: str, value: Any) -> None:
    """A sound scenario with one key more: nothing but ScenarioError."""
    tree = to_tree(mission())
    inner = tree[table]
    if isinstance(inner, dict):
        survives(lambda: from_tree({**tree, table: {**inner, key: value}}, "any"))
    survives(lambda: from_tree({**tree, key: value}, "any"))


@examples(200)
@given(
    path=st.lists(TOML_KEYS, min_size=1, max_size=3).map(".".join) | st.text(max_size=8),
    text=st.text(max_size=20),
    separator=st.sampled_from(["=", " = ", ""]),
)
def test_any_override_is_refused_or_a_scenario(path: str, text: str, separator: str) -> None:
    """Whatever is typed after --set: nothing but ScenarioError."""
    survives(lambda: mission(f"{path}{separator}{text}"))


@examples(100)
@given(text=st.text(max_size=60))
def test_any_text_is_refused_or_a_scenario(text: str) -> None:
    """Whatever a file holds: nothing but ScenarioError."""
    survives(lambda: parse(text, "any"))
