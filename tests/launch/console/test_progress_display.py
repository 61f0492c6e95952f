"""The progress display of a session, on a screen of any size and in plain lines."""

import pytest
from rich.console import Console

from headway.events import EvaluationFinished, Finished, IterationFinished, Started, Usage
from headway_launch.console.progress import JobProgress, makespan, overall, seconds_left
from headway_launch.console.progress_display import CountedProgress, Progress


def at(iteration: int, seconds_each: float = 2.0) -> IterationFinished:
    return IterationFinished(iteration, 1000 * iteration, Usage(), seconds_each * iteration, 1.0, 0.5)


def evaluated(value: float) -> EvaluationFinished:
    return EvaluationFinished(0, 0, "greedy", Usage(), value)


def job(seed: int, label: str = "ippo", iterations: int = 0, seconds_each: float = 2.0) -> JobProgress:
    """One that has done so many of ten iterations; none: it waits."""
    progress = JobProgress((seed,), 10, "greedy", iteration_steps=1000, label=label)
    if iterations:
        progress.take(Started(0, ()))
        progress.take(evaluated(350.0))
        for iteration in range(1, iterations + 1):
            progress.take(at(iteration, seconds_each))
    return progress


def lines_of(jobs: list[JobProgress], width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, force_terminal=False)
    with console.capture() as shown:
        console.print(Progress(jobs, 64)._screen(width, height))
    return [line.rstrip() for line in shown.get().splitlines()]


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 50), (40, 10), (80, 4)])
def test_hundreds_of_runs_fit_any_screen(width: int, height: int) -> None:
    labels = [f"an_algorithm_{place}, algo.lr 0.{place:04d}" for place in range(45)]
    jobs = [job(seed, label, iterations=5 if seed < 3 else 0) for label in labels for seed in range(10)]
    jobs[0].status = "finished"
    jobs[1].status = "failed"
    lines = lines_of(jobs, width, height)
    assert len(lines) < height
    assert max(map(len, lines)) <= width
    assert lines[0].startswith("2 of 450 runs ended (1 failed), 133 tr")
    assert any("more training" in line for line in lines)
    if height >= 10:
        assert any("more cells" in line for line in lines)


def test_few_runs_have_a_line_each_with_speed_and_time_left() -> None:
    jobs = [job(0, "ippo", 5), job(1, "ippo", 2), job(0, "mappo")]
    lines = lines_of(jobs, 80, 24)
    assert lines[0] == "0 of 3 runs ended, 2 training, 1,000 steps/s, about 0:00:20 left"
    assert lines[1:3] == ["ippo: 0 of 2 ended, return 350", "mappo: 0 of 1 ended"]
    assert [line.split() for line in lines[3:]] == [
        ["ippo,", "seed", "0", "5/10", "500", "steps/s", "return", "350", "0:00:10", "left"],
        ["ippo,", "seed", "1", "2/10", "500", "steps/s", "return", "350", "0:00:16", "left"],
    ]


def test_stopped_and_paused_jobs_have_not_ended() -> None:
    jobs = [job(0, "ippo", 5), job(1, "ippo", 2), job(2, "ippo", 2), job(3, "ippo", 10)]
    jobs[0].status = "finished"
    for each in jobs[1:]:
        each.take(Finished(each.iteration, stopped=True))
    assert [each.status for each in jobs[1:]] == ["stopped", "stopped", "paused"]
    assert overall(jobs, 2).startswith("1 of 4 runs ended, 1 paused, 2 stopped, 0 training")
    assert seconds_left(jobs, 2) is None  # nothing is left for this session
    lines = lines_of([*jobs, job(0, "mappo")], 80, 24)
    assert lines[1].startswith("ippo: 1 of 4 ended, 1 paused, 2 stopped")


def test_a_resumed_job_shows_the_steps_of_its_checkpoint() -> None:
    resumed = JobProgress((3,), 10, "greedy", iteration=4, iteration_steps=1000)
    assert resumed.cells()[1:3] == ("4/10", "4,000 steps")
    resumed.take(Started(3, ()))  # that checkpoint could not be read
    assert resumed.cells()[1:3] == ("3/10", "3,000 steps")
    resumed.take(at(5))
    assert resumed.cells()[2] == "5,000 steps"


def test_jobs_start_as_places_become_free() -> None:
    assert makespan([3.0, 1.0, 1.0, 1.0], 2) == 3.0
    assert makespan([1.0, 1.0, 1.0, 3.0], 2) == 4.0
    assert makespan([], 2) == 0.0


def test_time_left_counts_waiting_jobs_at_the_pace_of_their_cell() -> None:
    slow, fast = job(0, "slow", 5, seconds_each=10.0), job(0, "fast", 5, seconds_each=1.0)
    waiting = [job(seed, "fast") for seed in (1, 2)]
    assert seconds_left([slow, fast, *waiting], parallel=2) == pytest.approx(50.0)
    assert seconds_left([*waiting, fast], parallel=2) == pytest.approx(5 + 10)  # the second follows `fast`
    assert seconds_left([job(0)], parallel=2) is None
    # Of another cell, with iterations a tenth as long and ten times as many: a step takes as long.
    short = JobProgress((1,), 100, "greedy", iteration_steps=100, label="short")
    assert seconds_left([fast, short], parallel=1) == pytest.approx(5 + 10)
    both = JobProgress((1, 2), 10, "greedy", iteration_steps=1000, label="stacked")
    assert seconds_left([fast, both], parallel=1) == pytest.approx(5 + 20)
    fast.status = "finished"
    assert seconds_left([fast], parallel=2) is None


def test_elsewhere_many_jobs_have_one_line_together(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    moment = [0.0]
    monkeypatch.setattr("headway_launch.console.progress_display.time.monotonic", lambda: moment[0])
    jobs = [job(seed, iterations=3) for seed in range(6)]
    shown = Progress(jobs, 6)
    shown.show()
    assert len(capsys.readouterr().err.splitlines()) == 6  # each has begun
    shown.show()
    assert capsys.readouterr().err == ""
    moment[0] = 31.0
    shown.show()
    assert capsys.readouterr().err == overall(jobs, 6) + "\n"
    jobs[0].status = "failed"
    shown.show()
    assert "seed 0" in (line := capsys.readouterr().err)
    assert line.rstrip().endswith("failed")


def test_work_of_known_length_tells_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    moment = [0.0]
    monkeypatch.setattr("headway_launch.console.progress_display.time.monotonic", lambda: moment[0])
    with CountedProgress("days simulated", 20) as progress:
        assert progress.line == "days simulated: 0 of 20"
        for _ in range(4):
            moment[0] += 10.0
            progress.add()
    # Where lines cannot stay in place, one every half minute.
    assert capsys.readouterr().err == "days simulated: 3 of 20, about 0:02:50 left\n"
    with CountedProgress("steps played") as progress:
        progress.add()
    assert progress.line == "steps played: 1"
    with CountedProgress("episodes played", 6) as progress:
        progress.add(0, "rule idle, step 12")
        assert progress.line == "episodes played: 0 of 6 (rule idle, step 12)"
        progress.add(3, "rule idle, step 13")
    moment[0] += 1.0
    assert progress.line == "episodes played: 3 of 6, about 0:00:01 left (rule idle, step 13)"


def test_on_a_terminal_the_count_stays_in_place_and_goes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    with CountedProgress("days simulated", 2) as progress:
        progress.add(2)
        progress.note("a line that stays")
    drawn = capsys.readouterr().err
    assert drawn.count("a line that stays\n") == 1
    assert "days simulated: 2 of 2" in drawn.split("a line that stays")[1]
    assert drawn.endswith("\x1b[1A\x1b[2K")  # one line up, and clear it


def test_the_return_of_sampled_actions_is_shown_beside_the_greedy_one() -> None:
    """The greedy policy may not change for long, although training goes on."""
    progress = job(0, "ippo", 5)
    progress.take(EvaluationFinished(5, 5000, "sampled", Usage(), -12.34567))
    for width in (80, 120):
        line = lines_of([progress], width, 24)[-1]
        assert "return 350 (sampled -12.35)" in line
        assert line.endswith("0:00:10 left")
