"""`headway archive` and `verify`: what is published can be read, checked and trained again."""

import json
import shutil
import zipfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import NoReturn

import pytest
import yaml
from command_lines import failed, refused
from shuttle import SHUTTLE
from small_runs import SMALL

from headway.contracts.errors import HeadwayError
from headway.store import provenance as provenance_module
from headway.store.index import RunIndex
from headway_launch.commands.main import run
from headway_launch.runner.cell import SessionCell

STEPS = ("--steps", "1024")
"""The first iterations of the fixture's runs."""


@pytest.fixture
def archive(trained: Path, empty_folder: Path) -> Path:
    """An archive of the study `pair`, in the working directory."""
    assert run(["archive", "pair", "--store", str(trained)]) == 0
    return empty_folder / "pair.zip"


def changed(archive: Path, change: Callable[[str, bytes], bytes]) -> str:
    """Write `changed.zip` with other contents and the checksums that belong to them; return its name."""
    with zipfile.ZipFile(archive) as container:
        members = {name: container.read(name) for name in container.namelist()}
    manifest = json.loads(members.pop("manifest.json"))
    members = {name: change(name, content) for name, content in members.items()}
    manifest["files"] = {name: sha256(content).hexdigest() for name, content in members.items()}
    with zipfile.ZipFile("changed.zip", "w") as container:
        for name, content in {**members, "manifest.json": json.dumps(manifest).encode()}.items():
            container.writestr(name, content)
    return "changed.zip"


def with_gamma(name: str, content: bytes) -> bytes:
    if not name.endswith("config.yaml"):
        return content
    config = yaml.safe_load(content)
    config["algo"]["gamma"] = 0.5
    return yaml.safe_dump(config).encode()


def elsewhere(monkeypatch: pytest.MonkeyPatch, **changes: str) -> None:
    """Verify with other tags, by default those of another machine."""
    tags = {**provenance_module.provenance(), **(changes or {"hardware.cpu": "another"})}
    monkeypatch.setattr(provenance_module, "provenance", lambda: tags)


def verified(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[str]]:
    """Return the exit code of `headway verify` and the results in its table."""
    capsys.readouterr()
    code = run(["verify", *words])
    header, *rows = (line.split("\t") for line in capsys.readouterr().out.splitlines())
    assert header == ["run", "steps", "numbers", "result"]
    return code, [row[3] for row in rows]


@pytest.mark.parametrize(
    "words",
    [["runs", "--columns", "run_id,seed,final_reward,kwh,algo.gamma"], ["diff", "s0-2", "s1-2"],
     ["convert", "pair", "--to", "csv"], ["report", "pair", "--format", "csv"]],
    ids=lambda words: words[0],
)  # fmt: skip
def test_commands_read_it_as_a_store(
    words: list[str], archive: Path, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = []
    for source in (["--store", str(trained)], ["--archive", str(archive)]):
        capsys.readouterr()
        output = ["--output", source[0].lstrip("-")] if words[0] in ("convert", "report") else []
        assert run([*words, *output, *source]) == 0
        shown = capsys.readouterr().out.replace(source[0].lstrip("-"), "")
        lines = [line for line in shown.splitlines() if "hardware.host" not in line]
        folder = Path(source[0].lstrip("-"))
        files = sorted(folder.rglob("*.csv")) if output else []
        tables = {path.relative_to(folder): path.read_text() for path in files if path.name != "versions.csv"}
        found.append((lines, tables))
    assert found[0] == found[1]
    assert found[0][0]


def test_it_tells_its_size_licence_and_checksum_and_is_not_overwritten(
    archive: Path, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    words = ["archive", "pair", "--store", str(trained)]
    assert run([*words, "-o", "more.zip", "--checkpoints", "--licence", "CC0-1.0"]) == 0
    said = capsys.readouterr()
    assert said.out == "more.zip\n"
    digest = sha256(Path("more.zip").read_bytes()).hexdigest()
    assert said.err.startswith("2 runs of 1 cell, with checkpoints, ")
    assert said.err.endswith(f" MB, licence CC0-1.0, SHA-256 {digest}\n")
    with zipfile.ZipFile("more.zip") as container:
        assert "licensed under CC0-1.0" in container.read("LICENCE.txt").decode()
        assert "| 0,1 |" in container.read("README.md").decode()
        assert len([name for name in container.namelist() if name.endswith(".pt")]) == 2
    assert refused(*words) == "headway: --output: pair.zip exists; remove it or name a new file\n"
    assert "there is no folder no" in refused(*words, "-o", "no/pair.zip")
    assert "there is no study 'pear'" in refused("archive", "pear", "--store", str(trained))


def test_policies_are_there_if_they_were_asked_for(archive: Path, trained: Path) -> None:
    assert run(["archive", "pair", "--store", str(trained), "-o", "more.zip", "--checkpoints"]) == 0
    compare = ["compare", "pair", "--episodes", "2", "--rules", "random"]
    assert run([*compare, "--archive", "more.zip"]) == 0
    assert "pair.zip holds no checkpoint of run tracking-" in refused(*compare, "--archive", str(archive))
    assert "not allowed with argument" in refused("runs", "--archive", str(archive), "--store", str(trained))
    assert "--keep writes into" in refused("render", "s0", "--keep", "--archive", str(archive))


def test_runs_are_trained_again_bit_for_bit(
    archive: Path, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(path for path in trained.rglob("*") if path.suffix != ".sqlite")
    code, results = verified(capsys, str(archive), "--runs", "2", *STEPS)
    assert (code, results) == (0, ["equal bit for bit"] * 2)
    assert sorted(path for path in trained.rglob("*") if path.suffix != ".sqlite") == before


@pytest.mark.slow
def test_a_whole_run_is_trained_again_bit_for_bit(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert verified(capsys, str(archive), "s1") == (0, ["equal bit for bit"])


def test_another_discount_in_the_configuration_is_found_out(
    archive: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere(monkeypatch, **{"git.revision": "another"})
    code, [result] = verified(capsys, changed(archive, with_gamma), *STEPS)
    assert code == 1
    assert result.startswith("differs from step ")
    assert result.endswith(" there, another here")


def test_elsewhere_a_run_may_be_one_of_its_cells_seeds(
    archive: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere(monkeypatch)
    code, [result] = verified(capsys, changed(archive, with_gamma), *STEPS)
    assert code == 0
    assert result.startswith("within the tolerance: final reward ")
    assert verified(capsys, str(archive), *STEPS) == (0, ["equal bit for bit"])


def test_elsewhere_a_lone_seed_cannot_be_judged(
    trained: Path, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def only_first(name: str, content: bytes) -> bytes:
        if name.endswith("run.json") and (record := json.loads(content))["seed"] == 1:
            return json.dumps({**record, "status": "KILLED"}).encode()
        return content

    assert run(["archive", "pair", "--store", str(trained)]) == 0
    elsewhere(monkeypatch)
    line = refused("verify", changed(Path("pair.zip"), only_first))
    assert "hardware.cpu" in line
    assert "a tolerance needs two seeds of its cell" in line


def test_elsewhere_a_tolerance_needs_an_evaluation(
    empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy = ["experiment=toy_tracking", "study=late", "seed=0,1", "env_steps=3072", "energy=off"]
    assert run(["run", *toy, "evaluation.every=2048"]) == 0
    assert run(["archive", "late"]) == 0
    elsewhere(monkeypatch)
    assert "give at least --steps 2048" in refused("verify", "late.zip", "--steps", "1024")
    assert run(["verify", "late.zip", "--steps", "2048"]) == 0


def test_a_changed_byte_of_a_table_is_found(archive: Path) -> None:
    with zipfile.ZipFile(archive) as container:
        [member, *_] = [each for each in container.infolist() if "curve-" in each.filename]
    content = bytearray(archive.read_bytes())
    place = member.header_offset + 30 + len(member.filename) + member.compress_size // 2
    content[place] ^= 1
    Path("changed.zip").write_bytes(content)
    for command in (["verify", "changed.zip"], ["runs", "--archive", "changed.zip"]):
        assert f"changed.zip is damaged: {member.filename}" in refused(*command)


def test_a_run_that_starts_from_another_is_archived_with_it(
    trained: Path, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, "runs")
    toy = ["run", "experiment=toy_tracking", "env_steps=1024", "evaluation.every=512", "energy=off"]
    assert run([*toy, "study=child", "start.run=s0-2"]) == 0
    assert run(["archive", "child"]) == 0
    assert verified(capsys, "child.zip") == (0, ["equal bit for bit"])
    parent = min(row.run_id for row in RunIndex(Path("runs")).rows("pair"))
    assert f"{parent} is no finished run of study child" in refused("verify", "child.zip", parent)


@pytest.mark.usefixtures("archive")
def test_a_failed_retraining_names_no_file_of_the_folder_that_is_deleted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def training_job(*_: object) -> NoReturn:
        raise HeadwayError("the scenario is gone")

    monkeypatch.setattr(SessionCell, "training_job", training_job)
    told = failed("verify", "pair.zip", "s0", *STEPS)
    assert "seed 0 failed: the scenario is gone\n" in told
    assert "--debug shows the traceback" in told
    assert "Traceback" not in told


def test_files_that_it_does_not_hold_are_named_and_can_be_elsewhere_again(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("shuttle.py").write_text(SHUTTLE)
    assert run(["run", "env=./shuttle.py", "algo=ippo", "study=file", *SMALL, "env.shared_reward=false"]) == 0
    capsys.readouterr()
    assert run(["archive", "file"]) == 0
    line = f"not in the archive, and needed to train its runs again: env.id={empty_folder / 'shuttle.py'}"
    assert line in capsys.readouterr().err
    Path("lab").mkdir()
    Path("shuttle.py").rename("lab/shuttle.py")
    assert "there is no such file" in refused("verify", "file.zip")
    assert verified(capsys, "file.zip", "env.id=lab/shuttle.py") == (0, ["equal bit for bit"])


def test_files_of_the_environment_are_named_in_any_folder(
    trained: Path, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, "runs")
    Path("my.net.xml").touch()
    Path("lab").mkdir()
    for row in RunIndex(Path("runs")).rows():
        path = Path(row.directory, "config.yaml")
        config = yaml.safe_load(path.read_text())
        config["env"]["args"] = {"network": "my.net.xml", "scenario": "lab", "folder": "./lab", "kind": "a.b"}
        path.write_text(yaml.safe_dump(config))
    assert run(["archive", "pair"]) == 0
    named = [line for line in capsys.readouterr().err.splitlines() if "needed to train" in line]
    assert {line.rpartition(" ")[2] for line in named} == {
        "env.args.network=my.net.xml",
        "env.args.folder=./lab",
    }


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["pear.zip"], "pear.zip cannot be read (No such file or directory)"),
        (["pair.zip", "s7"], "no run 's7'"),
        (["pair.zip", "s0", "--runs", "2"], "--runs and --seed draw runs"),
        (["pair.zip", "--runs", "0"], "--runs 0: must be at least 1"),
        (["pair.zip", "--runs", "3"], "--runs 3: the archive holds 2 finished runs"),
        (["pair.zip", "--steps", "few"], "--steps few: give a whole number"),
        (["pair.zip", "--steps", "0"], "--steps 0: must be at least 1"),
        (["pair.zip", "algo.gamma=0.5"], "algo.gamma=0.5: a run is trained again as it was"),
    ],
)
@pytest.mark.usefixtures("archive")
def test_bad_input_is_one_line(words: list[str], line: str) -> None:
    assert line in refused("verify", *words)


def test_a_study_without_finished_runs_has_no_archive(trained: Path, empty_folder: Path) -> None:
    shutil.copytree(trained, "runs")
    for row in RunIndex(Path("runs")).rows():
        path = Path(row.directory, "run.json")
        path.write_text(json.dumps(json.loads(path.read_text()) | {"status": "KILLED"}))
    assert "has no finished run (2 KILLED)" in refused("archive", "pair")
    assert not Path("pair.zip").exists()
