"""`headway report`: write a study's report as one page, with its tables and plots as files."""

import argparse
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway_launch.commands.runs import add_store_argument, existing_store

EXAMPLES = """\
examples:
  headway report bus                                          writes report-bus/report.html
  headway report bus --output supplement
  headway report bus --metric evaluation_sampled/return
  headway report bus --metric evaluation_greedy/mean_wait_min --lower-is-better

Writes one self-contained page, report.html, and beside it tables/ (Markdown, and CSV with all digits),
pictures/ (PNG), configs/ and commands.txt. Only reads the store; nothing is trained or evaluated.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study, the metric and the folder."""
    parser.add_argument("study", metavar="STUDY", help="name of the study, as in `headway runs`")
    parser.add_argument("--output", metavar="DIR", help="folder to write (default: report-STUDY)")
    parser.add_argument(
        "--metric", help="evaluation metric of final rewards (default: evaluation_greedy/return)"
    )
    parser.add_argument(
        "--lower-is-better", action="store_true", help="the metric is a cost, such as a waiting time"
    )
    parser.add_argument(
        "--low", type=float, default=None, help="lower end of the vertical axis of the learning curves"
    )
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Write the report and print its path."""
    root = existing_store(arguments.store)
    folder = Path(arguments.output or f"report-{arguments.study}")
    if folder.exists() and not folder.is_dir():
        raise HeadwayError(f"--output: {folder} is a file; name a folder")
    from headway_launch.report.page import write_report
    from headway_launch.report.study_data import StudyData
    from headway_launch.report.study_report import report_of

    data = StudyData(root, arguments.study, arguments.metric, arguments.lower_is_better, arguments.low)
    print(write_report(report_of(data), folder))
    return 0
