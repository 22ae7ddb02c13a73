"""Progress in a terminal, in a log, and at a bearable pace."""

import io
from typing import Literal

import msgspec
import pytest
from rich.console import Console

from kantor_fleet.report.progress import ProgressView, line_of
from kantor_protocol.wire.messages import VERSION, Progress

UNDER_WAY = Progress(
    version=VERSION,
    now_ns=12_300_000_000,
    phase="running",
    detail="",
    energy_spent=615,
    energy_total=5000,
    detected=47,
    targets=300,
    w_ub=2311.42,
    links=3,
    messages_per_s=41.7,
    robots_done=0,
    robots=5,
    mass_left=0.43,
)
LINE = "t=  12.3 s  explored 57 %  energy 615/5000  detected 47/300  W_UB 2311.4  links 3  msg/s 42  done 0/5"


ON_A_MAP = msgspec.structs.replace(
    UNDER_WAY,
    energy_spent=0,
    energy_total=0,
    detected=0,
    targets=0,
    w_ub=0.0,
    distance_m=321.4,
)


class ManualClock:
    """Real time as the test wants it."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Log:
    """A view that writes where no terminal is."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self._file = io.StringIO()
        console = Console(file=self._file, width=40, force_terminal=False)
        self.view = ProgressView("fleet", console, self.clock)

    @property
    def lines(self) -> list[str]:
        """What it has written."""
        return self._file.getvalue().splitlines()


def at(now_s: float, **changes: object) -> Progress:
    """The progress of a mission under way, at another simulated time."""
    return msgspec.structs.replace(UNDER_WAY, now_ns=round(now_s * 1e9), **changes)


def screen(progress: Progress, *notes: str, width: int = 80, colours: bool = False) -> str:
    """Everything that a terminal was sent to show one progress."""
    file = io.StringIO()
    kind: Literal["standard"] | None = "standard" if colours else None
    console = Console(
        file=file, width=width, force_terminal=True, color_system=kind, legacy_windows=False
    )
    with ProgressView("fleet", console, ManualClock()) as view:
        view.show(progress)
        for note in notes:
            view.note(note)
    return file.getvalue()


def test_mission_under_way_is_one_line() -> None:
    """A line has everything, in a fixed order, to be read and to be cut with tools."""
    assert line_of(UNDER_WAY) == LINE


def test_line_of_a_mission_without_targets_omits_them() -> None:
    """A line does not show 0/0."""
    line = line_of(msgspec.structs.replace(UNDER_WAY, detected=0, targets=0))

    assert line == LINE.replace("  detected 47/300", "")


def test_line_of_a_mission_on_a_map_has_distances_and_no_bounds() -> None:
    """There is neither energy nor W_UB where a map is explored."""
    line = "t=  12.3 s  explored 57 %  distance 321 m  links 3  msg/s 42  done 0/5"
    shown = screen(ON_A_MAP)

    assert line_of(ON_A_MAP) == line
    assert "distance 321 m" in shown
    assert "57 %" in shown
    assert "W_UB" not in shown
    assert "energy" not in shown


@pytest.mark.parametrize(
    ("w_ub", "digits"), [(99999.96, "100000.0"), (37.0412, "37.04"), (0.1984, "0.1984"), (0.0, "0")]
)
def test_bound_keeps_its_digits_as_it_falls(w_ub: float, digits: str) -> None:
    """W_UB falls over orders of magnitude; a small one is not rounded away."""
    line = line_of(msgspec.structs.replace(UNDER_WAY, w_ub=w_ub))

    assert f"  W_UB {digits}  " in line


def test_line_of_a_wait_names_the_missing_only() -> None:
    """Before the start there is nothing to measure."""
    assert line_of(at(0.0, phase="waiting", detail="r2, r3")) == "t=   0.0 s  waiting for r2, r3"
    assert line_of(at(0.0, phase="waiting")) == "t=   0.0 s  waiting"


def test_last_line_has_the_reason_of_the_end() -> None:
    """The last line of a mission has its reason."""
    assert line_of(at(12.3, phase="over", detail="limit")) == f"{LINE}  over: limit"


def test_log_takes_a_line_a_second() -> None:
    """At most one line a second of real time, whatever simulated time does."""
    log = Log()
    with log.view as view:
        for step in range(35):
            view.show(at(float(step)))
            log.clock.now_s += 0.125

    times = [line.split()[1] for line in log.lines]
    assert times == ["0.0", "8.0", "16.0", "24.0", "32.0", "34.0"]


def test_last_progress_is_shown_on_leaving() -> None:
    """What the pace held back is shown in the end, and only once."""
    log = Log()
    with log.view as view:
        view.show(at(0.0))
        view.show(at(1.0))
        view.show(at(2.0))
        assert len(log.lines) == 1

    assert [line.split()[1] for line in log.lines] == ["0.0", "2.0"]


def test_last_progress_is_shown_when_the_mission_fails() -> None:
    """An exception passes through, after how far it came."""
    log = Log()

    def fail() -> None:
        with log.view as view:
            view.show(at(0.0))
            view.show(at(1.0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [line.split()[1] for line in log.lines] == ["0.0", "1.0"]


def test_end_does_not_wait_for_its_second() -> None:
    """The end of the mission is shown at once: drawing the report may take longer."""
    log = Log()
    with log.view as view:
        view.show(at(0.0))
        view.show(at(1.0, phase="over", detail="done"))

        assert log.lines[-1].endswith("over: done")

    assert len(log.lines) == 2


def test_long_wait_is_one_line() -> None:
    """An unchanged line is not printed again."""
    log = Log()
    with log.view as view:
        for _ in range(60):
            view.show(at(0.0, phase="waiting", detail="r2, r3"))
            log.clock.now_s += 1.0
        view.show(at(0.0, phase="waiting", detail="r3"))

    assert log.lines == ["t=   0.0 s  waiting for r2, r3", "t=   0.0 s  waiting for r3"]


def test_nothing_shown_writes_nothing() -> None:
    """A mission without progress leaves an empty log."""
    log = Log()
    with log.view:
        pass

    assert log.lines == []


def test_notes_come_at_once_and_whole() -> None:
    """A note does not wait, and is neither wrapped nor read as markup: it may be a command."""
    command = "kantor agent r1 --connect tcp/127.0.0.1:7447 --credentials [red]/a/long/folder[/red]"
    log = Log()
    with log.view as view:
        view.show(at(0.0))
        view.note(command)
        view.note(command)

    assert log.lines[1:] == [command, command]


def test_text_of_other_processes_cannot_control_the_terminal() -> None:
    """Details and notes may come from other processes; escape sequences in them have no effect."""
    line = line_of(at(0.0, phase="waiting", detail="r1\x1b[2J\r\n"))
    assert line == "t=   0.0 s  waiting for r1?[2J??"

    sent = screen(at(0.0, phase="waiting", detail="\x1b]0;title\x07"), "note \x1b[2J")
    assert "\x1b]0;" not in sent
    assert "\x1b[2J" not in sent


def test_terminal_shows_a_panel() -> None:
    """A terminal has everything that a line has, in a frame with the scenario's name."""
    shown = screen(UNDER_WAY)

    for word in ("fleet", "t=  12.3 s", "615/5000", "47/300", "2311.4", "links", "42", "0/5"):
        assert word in shown
    assert "╭" in shown
    assert "━" in shown


def test_terminal_names_missing_robots() -> None:
    """While waiting, the panel shows the missing robots alone."""
    shown = screen(at(0.0, phase="waiting", detail="r2, r3"))

    assert "waiting for r2, r3" in shown
    assert "energy" not in shown


def test_narrow_terminal_breaks_no_figure() -> None:
    """Where the figures need two lines, each stays with its name."""
    shown = screen(UNDER_WAY, width=44)

    for figure in ("detected 47/300", "W_UB 2311.4", "links 3", "msg/s 42", "done 0/5"):
        assert figure in shown
    assert max(len(line) for line in shown.splitlines() if "│" in line) <= 44


def test_terminal_refreshes_ten_times_a_second() -> None:
    """The panel is drawn at the pace of real time, however fast the mission runs."""
    file, clock = io.StringIO(), ManualClock()
    console = Console(file=file, width=80, force_terminal=True)
    with ProgressView("fleet", console, clock) as view:
        for step in range(100):
            view.show(at(step / 10.0))
            clock.now_s += 1.0 / 64.0

    # 100 steps take 1.56 s; each refresh waits for the seventh step; the last one is extra.
    assert file.getvalue().count("╭") == pytest.approx(17, abs=1)


def test_no_color_is_honoured(monkeypatch: pytest.MonkeyPatch) -> None:
    """NO_COLOR takes the colours from the panel, not the panel."""
    colour = "\x1b[3"
    assert colour in screen(UNDER_WAY, colours=True)

    monkeypatch.setenv("NO_COLOR", "1")
    shown = screen(UNDER_WAY, colours=True)

    assert colour not in shown
    assert "╭" in shown


def test_pipe_stays_plain_with_forced_colours(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """FORCE_COLOR, as CI services set it, makes no terminal of a pipe; output goes to stdout."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    with ProgressView("fleet") as view:
        view.show(UNDER_WAY)

    captured = capsys.readouterr()
    assert captured.out == LINE + "\n"
    assert captured.err == ""
