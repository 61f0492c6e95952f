"""The life of a run whose environment is a Python file: trained, resumed, evaluated, edited, removed."""

from pathlib import Path

import pytest
from command_lines import failed, output, refused, rows_of
from shuttle import SHUTTLE
from small_runs import SMALL, end_as, stored_rows

from headway.adapters.env_file import EnvFile
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose
from headway_launch.experiments.sweep import compose_sweep

FILE = Path("my lab/shuttle.py")
SWEEP = ("sweep", "env=my lab/shuttle.py", "algo=ippo", "study=own", *SMALL, "env.shared_reward=false")


@pytest.fixture
def _file(empty_folder: Path) -> None:
    FILE.parent.mkdir()
    FILE.write_text(SHUTTLE)


@pytest.mark.slow
@pytest.mark.usefixtures("_file")
def test_a_run_finds_its_file_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is found from another folder. An edited file is another cell; if the file was removed, only
    commands that play it are refused."""
    shown = output(*SWEEP)
    assert "imported" in shown.err
    assert "imported" not in shown.out
    [first] = stored_rows()
    file = (tmp_path / FILE).resolve()
    assert first.environment == str(file)
    assert first.run_id.startswith("shuttle-ippo-")

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    store = f"--store={tmp_path / 'runs'}"
    end_as(first.directory)
    assert run(["resume", first.run_id, store]) == 0
    evaluate = ["evaluate", first.run_id, "--episodes=1", store]
    shown = output(*evaluate)
    assert "has changed" not in shown.err
    # Each of 5 steps pays 1 and 2: see SHUTTLE.
    assert "\nippo\t1\t7.500\t+0\n" in shown.out

    file.write_text(SHUTTLE.replace("FARE = 1.0", "FARE = 3.0"))
    shown = output(*evaluate)
    assert f"headway: {file} has changed since the run was started" in shown.err
    assert "\nippo\t1\t22.50\t+0\n" in shown.out
    end_as(first.directory)
    stale = f"env.file_digest={EnvFile(str(file), SHUTTLE.encode()).digest}"
    for words in (("resume", first.run_id, store), ("run", f"env={file}", "algo=ippo", stale)):
        assert f"{file} has changed since its digest" in refused(*words)
    end_as(first.directory, "FINISHED")
    monkeypatch.chdir(tmp_path)
    assert "has changed" not in output(*SWEEP).err
    one, other = stored_rows()
    assert one.cell != other.cell

    file.unlink()
    for words in (evaluate, ["resume", "--study=own", store], SWEEP):
        end_as(first.directory)
        assert f"env.id={file}: there is no such file; correct the path, or restore" in refused(*words)
    end_as(first.directory, "FINISHED")
    for words in (["runs"], ["report", "own", "--output", "page"], ["diff", one.run_id, other.run_id]):
        output(*words)
    assert "shuttle.py, env.file_digest=" in Path("page/report.html").read_text()


@pytest.mark.usefixtures("_file")
def test_a_rule_that_a_file_does_not_have_is_named_even_if_its_budget_is_too_large() -> None:
    line = failed("run", f"env={FILE}", "algo=ippo", "start.rule=nerest", "start.env_steps=9", "env_steps=9")
    assert "shuttle.py has no rule to start from" in line


@pytest.mark.slow
@pytest.mark.usefixtures("_file")
def test_an_error_of_the_file_is_named_with_its_line() -> None:
    """Training fails after a second attempt, evaluation at once; export compares random observations."""
    assert run(SWEEP) == 0
    [trained] = stored_rows()
    lines = SHUTTLE.splitlines()
    [place] = [number for number, line in enumerate(lines) if line.strip().startswith("def step(")]
    lines.insert(place + 1, "        raise KeyError('the bridge is out')")
    FILE.write_text("\n".join(lines))
    told = f"raised KeyError: 'the bridge is out' in step (shuttle.py, line {place + 2})"
    cause = f"environment '{FILE.resolve()}' {told}"
    assert f"failed twice: {cause}" in failed("run", *SWEEP[1:], "seed=0")
    assert failed("evaluate", trained.run_id, "--episodes=1").endswith(f"headway: {cause}\n")
    assert f"observations drawn at random ({cause})" in output("export", trained.run_id).err


def test_a_notice_on_the_rewards_is_printed_before_training_only(empty_folder: Path) -> None:
    Path("team.py").write_text(SHUTTLE.replace(" * (i + 1)", ""))
    notice = "got equal rewards in a few steps of random play"
    assert notice in output("run", "env=./team.py", "algo=ippo", *SMALL).err
    [stored] = stored_rows()
    for words in (
        ("compare", "env=./team.py", "--episodes=2"),
        ("evaluate", stored.run_id, "--episodes=2"),
        ("export", stored.run_id),
        ("archive", "default", "--output=team.zip"),
        ("verify", "team.zip"),
    ):
        assert notice not in output(*words).err


def test_a_rule_with_invalid_actions_is_refused_before_training(empty_folder: Path) -> None:
    rule = """
from headway.contracts import RuleEntry

class Fast:
    def act(self, env, observed):
        return np.full(observed.alive.shape, 2)

RULES = {"fast": RuleEntry("drives too fast", lambda prepared: Fast())}
"""
    Path("fast.py").write_text(SHUTTLE + rule)
    words = ("run", "env=./fast.py", "algo=ippo", *SMALL, "evaluation.rules=[fast]")
    line = "headway: rule fast returned action 2; Discrete(2) has 0 to 1; correct the rule\n"
    assert failed(*words).endswith(line)
    assert stored_rows() == []


@pytest.mark.usefixtures("_file")
def test_files_in_several_forms_of_overrides() -> None:
    file = str(FILE.resolve())
    for word in (f"env={FILE}", f"env={file}", f"env='{FILE}'", f"env.id='{FILE}'"):
        assert compose([word, "algo=ippo", "env.args.fare=2"]).config.env.id == file
    other = FILE.with_name("other shuttle.py")
    other.write_text(SHUTTLE)
    both = compose_sweep([f"env={FILE},{other}", "algo=ippo"])
    assert [each.config.env.id for each in both] == [file, str(other.resolve())]
    assert ["env.args.fare", "number", "1.0", ""] in rows_of("list", "envs", str(FILE))
    assert "env.args.fares is not a key of" in refused("run", f"env={FILE}", "env.args.fares=2")
    assert refused("run", "env=my lab/shuttel.py").startswith(f"headway: env.id={Path('my lab').resolve()}")


def test_names_of_files_without_their_path_are_recognised(empty_folder: Path) -> None:
    Path("lab").mkdir()
    for name in ("shuttle.py", "lab/shuttle.py"):
        Path(name).write_text(SHUTTLE)
    assert refused("run", "env=shuttle").endswith(", or your file env=./shuttle.py\n")
    assert refused("run", "env=lab.shuttle").endswith("; for your own file write env=./lab/shuttle.py\n")
    assert "env.file_digest is for" in refused("run", "env=trivial", "env.file_digest=abc")
    module = "env=mpe2.simple_spread_v3"
    assert "env.file_digest is for Python files only" in refused("run", module, "env.file_digest=abc")
