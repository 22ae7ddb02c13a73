"""World-sim under an engine that starts it again: it goes on with its run, and does not try a failed one for ever."""

import signal
from typing import TYPE_CHECKING

from kantor_protocol.transport.endpoint import free_endpoint
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import await_line, incidents_of, result_of

if TYPE_CHECKING:
    from support.processes.command import Kantor


def test_a_killed_world_sim_resumes_its_run_and_a_done_one_starts_another(kantor: "Kantor") -> None:
    """The same command each time, as an engine gives it."""
    endpoint = free_endpoint()
    command = (
        "worldsim", "fleet", "--listen", endpoint, "--speed", 8, "--state", "standing",
        "--set", "robots.count=1", "starts.random=true", "samples.count=300", "energy.points=400",
    )  # fmt: skip
    first = kantor.start(*command)
    await_line(first, "  kantor agent r1")
    robot = kantor.start("agent", "r1", "--connect", endpoint)
    await_line(first, "t=", "explored")
    first.send_signal(signal.SIGKILL)
    first.wait()
    second = kantor(*command)

    assert second.code == 0, second.err
    assert robot.wait(EVENT_LIMIT_S) == 0
    (run,) = kantor.runs()
    assert result_of(run)["ended"] == "done"
    assert [i.kind for i in incidents_of(run) if i.who == "worldsim"] == ["leave", "join"]

    third = kantor.start(*command)
    await_line(third, "t=", "waiting for r1")
    third.send_signal(signal.SIGTERM)
    assert third.wait(EVENT_LIMIT_S) == 143
    assert len(kantor.runs()) == 2


def test_a_mission_that_was_not_met_is_not_tried_again(kantor: "Kantor") -> None:
    """It tells so, with the same exit code, and makes no other run."""
    endpoint = free_endpoint()
    command = (
        "worldsim", "fleet", "--listen", endpoint, "--speed", 8, "--state", "standing",
        "--set", "robots.count=1", "starts.random=true", "limit_s=8",
    )  # fmt: skip
    first = kantor.start(*command)
    await_line(first, "  kantor agent r1")
    kantor.start("agent", "r1", "--connect", endpoint)
    first.communicate(timeout=EVENT_LIMIT_S)
    again = kantor(*command)

    assert (first.returncode, again.code) == (1, 1)
    assert "its mission is over (limit), and was not met" in again.err
    assert len(kantor.runs()) == 1
