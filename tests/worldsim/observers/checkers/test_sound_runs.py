"""The checker is silent on the record of a sound run, whatever its radio, its clocks and its process faults."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.record.records import Ending
from support.records import Play, batches, opening, own_register, process_events, step_records
from support.strategies import SEEDS, examples
from support.variants import MERGES, PROCESS_FAULTS, RADIOS, SPECTRAL, Overrides


@pytest.mark.parametrize(
    ("merge", "coordination", "order", "radio"),
    list(product(MERGES, ("decentralized", "centralized"), ("turn", "concurrent"), RADIOS)),
)
def test_sound_run_breaks_no_rule(
    played: Play, merge: str, coordination: str, order: str, radio: str
) -> None:
    """Whatever the merge, the coordination, the order and the radio: the rules hold."""
    overrides = (f"coordination={coordination}", f"clock.order={order}")
    records = played(*MERGES[merge], *RADIOS[radio], *overrides)

    assert check(records).violations == []
    assert isinstance(records[-1], Ending)
    assert records[-1].reason == "done"


@pytest.mark.parametrize("radio", RADIOS)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_sound_run_with_registers_breaks_no_rule(
    played: Play, coordination: str, radio: str
) -> None:
    """Sums over places, whatever becomes of the messages that carry them."""
    records = played(*SPECTRAL, *RADIOS[radio], f"coordination={coordination}")

    assert check(records).violations == []
    origins = len(opening(records).scenario.roster)
    writes = [own_register(step_record, origins) for step_record in step_records(records, "r1")]
    assert max(writes) > 5


@examples(25)
@given(
    merge=st.sampled_from(list(MERGES.values())),
    coordination=st.sampled_from(["decentralized", "centralized"]),
    order=st.sampled_from(["turn", "concurrent"]),
    range_m=st.sampled_from([0, 25, 60, 200]),
    drop=st.sampled_from([0.0, 0.3, 0.7]),
    duplicate=st.sampled_from([0.0, 0.5]),
    delay_s=st.sampled_from([0.0, 0.02, 0.1, 0.35]),
    jitter_s=st.sampled_from([0.0, 0.05, 0.4]),
    reorder=st.sampled_from([0.0, 0.4]),
    spread=st.sampled_from([0.0, 0.4]),
    late_s=st.sampled_from([0.0, 0.04]),
    seed=SEEDS,
)
def test_no_radio_or_clock_makes_a_sound_run_break_a_rule(
    played: Play,
    merge: Overrides,
    coordination: str,
    order: str,
    range_m: int,
    drop: float,
    duplicate: float,
    delay_s: float,
    jitter_s: float,
    reorder: float,
    spread: float,
    late_s: float,
    seed: int,
) -> None:
    """No loss, delay or clock makes a sound robot break a rule."""
    records = played(
        *merge,
        f"coordination={coordination}",
        f"clock.order={order}",
        f"clock.spread={spread}",
        f"clock.jitter_s={late_s}",
        f"radio.range_m={range_m}",
        f"radio.drop={drop}",
        f"radio.duplicate={duplicate}",
        f"radio.delay_s={delay_s}",
        f"radio.jitter_s={jitter_s}",
        f"radio.reorder={reorder}",
        seed=seed,
    )

    assert check(records).violations == []


@pytest.mark.parametrize("faults", PROCESS_FAULTS, ids=lambda faults: faults[0].split("'")[1])
@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("planner", [(), SPECTRAL, ("coordination=centralized",)])
def test_no_process_fault_makes_a_sound_run_break_a_rule(
    played: Play, faults: Overrides, merge: str, planner: Overrides
) -> None:
    """Sound robots break no rule when faults stop their processes, change their clocks or forge messages."""
    records = played(*faults, *MERGES[merge], *planner)

    assert check(records).violations == []
    assert process_events(records) or any(batch.injected for batch in batches(records))
