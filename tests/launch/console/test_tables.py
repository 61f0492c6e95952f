"""Tables as a terminal of any width, and a pipe, show them."""

import csv
import io
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from command_lines import output, rows_of
from stored_runs import keep

from headway_launch.commands.main import run as run_command
from headway_launch.console.tables import print_table

COLUMNS = ("name", "what it is", "first", "second figure")
ROWS = (("alpha", "a long description of a thing", 123456, 0.0001234), ("beta", "short", 7, None))


LinesAt = Callable[[int, Callable[[], object]], list[str]]


@pytest.fixture
def lines_at(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> LinesAt:
    """(width, call) -> the lines that a call prints at a terminal of that width, without styles."""

    def lines(width: int, call: Callable[[], object]) -> list[str]:
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setenv("TERM", "xterm")
        call()
        return re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()

    return lines


@pytest.mark.parametrize("width", [200, 60, 50])
def test_numbers_never_break_and_text_gives(width: int, lines_at: LinesAt) -> None:
    lines = lines_at(width, lambda: print_table(COLUMNS, ROWS, spare=("second figure",)))
    assert max(map(len, lines)) <= width
    assert any("123,456" in line and "0.0001234" in line for line in lines)
    assert "omitted" not in lines[-1]


def test_spare_columns_go_first_and_that_is_said(lines_at: LinesAt) -> None:
    lines = lines_at(40, lambda: print_table(COLUMNS, ROWS, spare=("second figure", "first")))
    assert any("123,456" in line for line in lines)
    assert not any("0.0001234" in line for line in lines)
    assert lines[-1] == "columns omitted on this narrow terminal: second figure"


def test_what_cannot_fit_is_printed_as_lists(lines_at: LinesAt) -> None:
    lines = lines_at(24, lambda: print_table(COLUMNS, ROWS, title="things", spare=("second figure",)))
    assert lines[:2] == ["things", "name           alpha"]
    assert "second figure  0.0001234" in lines  # lists have room for all
    assert not any("omitted" in line for line in lines)


def test_before_rows_become_lists_whole_columns_break(lines_at: LinesAt) -> None:
    identity = "merge_two_lane-mappo-bda0c7-s0-20261122-110412-cc57"
    lines = lines_at(40, lambda: print_table(("run", "reward"), [(identity, 0.123)], whole=("run",)))
    assert max(map(len, lines)) <= 40
    cells = [[cell.strip() for cell in line.split("│")[1:3]] for line in lines if line.startswith("│")]
    assert "".join(cell for cell, _ in cells) == identity
    assert [number for _, number in cells if number] == ["0.123"]


def test_a_pipe_gets_every_column_and_the_digits_of_a_terminal(
    lines_at: LinesAt, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has no separators of thousands, with which `sort -n` and awk cannot read a number."""
    columns = ("a", "b", "c", "d", "e")
    rows = [(174.125, 20480.4, 1234567.0, 123456789, None), (0.00217355, "x\ny", 0.0, -9999.6, 2)]
    on_terminal = lines_at(200, lambda: print_table(columns, rows))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: False)
    print_table(columns, rows)
    piped = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert piped == [
        ["a", "b", "c", "d", "e"],
        ["174.1", "20480", "1234567", "123456789", ""],
        ["0.002174", "x y", "0", "-10000", "2"],
    ]
    cells = [cell.strip().replace(",", "") for line in on_terminal for cell in line.split("│")[1:-1]]
    assert set(cells) >= {cell for row in piped[1:] for cell in row if cell not in ("", "x y")}


@pytest.fixture
def store(tmp_path: Path) -> Path:
    summary = {"final_reward": 2 / 3, "auc": 1 / 3, "kwh": 1.2345678e-5, "kg_co2": 2.3456789e-6}
    progress = {"iterations": 147, "durable_iteration": 147, "durable_env_steps": 602112}
    keep(tmp_path, "bus", 0, "bus", "mappo", "bus-mappo-1f2e3d", summary, policies="shared", **progress)
    return tmp_path


@pytest.mark.parametrize("width", [200, 90, 70])
def test_runs_keep_identity_status_and_result_whole(width: int, store: Path, lines_at: LinesAt) -> None:
    lines = lines_at(width, lambda: run_command(["runs", "--store", str(store)]))
    assert max(map(len, lines[:-1])) <= width  # the last line may tell what is left out
    row = next(line for line in lines if "bus-mappo-1f2e3d-s0" in line)
    assert re.search(r"-[0-9a-f]{4} .*FINISHED .*0\.6667 ", row)
    for name, figure in (("env steps", "602,112"), ("AUC", "0.3333"), ("kWh", "1.235e-05")):
        field = {"env steps": "env_steps", "AUC": "auc", "kWh": "kwh"}[name]
        assert figure in row or re.search(rf"^columns left out: .*\b{field}\b", lines[-1])
    if width >= 80:
        assert re.search(r"│ mappo +│", row)


def test_runs_name_the_columns_left_out(store: Path) -> None:
    """The names are those that --columns takes; a column in which no run has a value is not missed."""
    shown, note = output("runs", "--store", str(store))
    assert shown.splitlines()[0].split("\t") == [
        "run", "study", "algorithm", "seed", "status", "env steps", "final reward", "AUC (own range)",
        "CPU s", "kWh",
    ]  # fmt: skip
    assert len(shown.splitlines()) == 2
    assert note == (
        "columns left out: environment, policies, iterations, kg_co2, started "
        "(choose with --columns; --format csv has all)\n"
    )
    named = "environment,policies,iterations,kg_co2"
    shown, note = output("runs", "--store", str(store), "--columns", named)
    assert shown.splitlines()[1].split("\t") == ["bus", "shared", "147", "2.346e-06"]
    assert note == ""


def test_runs_call_the_auc_what_it_is_and_csv_has_fields_and_all_digits(store: Path) -> None:
    header, row = rows_of("runs", "--store", str(store))
    assert row[header.index("AUC (own range)")] == "0.3333"
    [fields] = csv.DictReader(io.StringIO(output("runs", "--store", str(store), "--format", "csv").out))
    assert float(fields["auc"]) == 1 / 3
    assert float(fields["final_reward"]) == 2 / 3
