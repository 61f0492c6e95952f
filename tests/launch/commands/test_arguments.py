"""Arguments that several commands take."""

import argparse

import pytest

from headway_launch.commands.arguments import typed_line


@pytest.mark.parametrize(
    ("typed", "line"),
    [
        (["bus", "--store", "/lab/a b/runs", "--low", "-3"], "bus --store FOLDER/runs --low -3"),
        (["--out=/lab/page", "--sto", "here/runs", "bus"], "--out=FOLDER/page --sto here/runs bus"),
        (["-o", "/lab/page", "bus"], "-o FOLDER/page bus"),
        (["env=/lab/shuttle.py", "env.args.town=~/town"], "env=FOLDER/shuttle.py env.args.town=FOLDER/town"),
        (["env=pettingzoo:sisl/pursuit-v5", "./a/b.yaml"], "env=pettingzoo:sisl/pursuit-v5 ./a/b.yaml"),
        (["env.args={a:/x/y,b:[/x/z]}"], "'env.args={a:FOLDER/y,b:[FOLDER/z]}'"),
        (
            ["--metric", "a b", "--where=seed/2>3 / 4", "--", "bus"],
            "--metric 'a b' '--where=seed/2>3 / 4' -- bus",
        ),
    ],
)
def test_a_command_line_to_show_names_no_folder_of_the_machine(typed: list[str], line: str) -> None:
    assert typed_line(argparse.Namespace(command="report", typed=typed)) == f"headway report {line}"
