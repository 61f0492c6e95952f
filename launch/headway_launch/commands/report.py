"""`headway report`: write a report of studies as a page of HTML or Markdown, or its parts for a paper."""

import argparse
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway_launch.commands.arguments import (
    add_store_argument,
    add_where_argument,
    named_studies,
    typed_line,
)
from headway_launch.report.report_files import FORMATS, table_text, write_report

EXAMPLES = """\
examples:
  headway report bus                                          writes report-bus/report.html
  headway report bus --output supplement
  headway report bus --format markdown --output docs/bus      a page for a site, docs/bus/report.md
  headway report bus --format latex --output paper            tables and pictures for a paper
  headway report bus --table energy --format markdown         print one table, also as latex or csv
  headway report bus merge old/runs:crossing                  ranks and normalised scores over environments
  headway report bus --metric evaluation_sampled/return
  headway report bus --metric mean_wait_min --lower-is-better
  headway report bus --where 'algorithm=mappo or algorithm=ippo'

html: one self-contained page, report.html, and beside it tables/ (CSV with all digits), pictures/ (PNG),
configs/ and commands.txt. markdown: the same page as report.md, for GitHub and for Sphinx with MyST; it shows
pictures/ (SVG) and links configs/, commands.txt and the table of runs. latex: tables/ (tabular, for the
package booktabs) and pictures/ (PDF). csv: tables/ alone. Existing files of those names are replaced. Only
reads the store; nothing is trained or evaluated.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study, the format, the folder and the metric."""
    parser.add_argument(
        "study",
        metavar="STUDY",
        nargs="+",
        help="names of studies, as in `headway runs`, or STORE:STUDY for one of another store",
    )
    parser.add_argument("--format", choices=FORMATS, default="html", help="what to write (default: html)")
    parser.add_argument(
        "--table", metavar="NAME", help="print only this table, named as its file in tables/; not with html"
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        help="folder to write (default: report-STUDY, or report-STUDY-STUDY...)",
    )
    parser.add_argument(
        "--metric",
        help="evaluation metric of final rewards; a name without group is of evaluation_greedy "
        "(default: return)",
    )
    add_where_argument(parser)
    parser.add_argument(
        "--lower-is-better", action="store_true", help="the metric is a cost, such as a waiting time"
    )
    parser.add_argument(
        "--low", type=float, default=None, help="lower end of the vertical axis of the learning curves"
    )
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Write the report and print the path of its page, or of its folder if it has none; or print a table."""
    if arguments.table is not None and arguments.format == "html":
        raise HeadwayError("--table prints a table as --format markdown, latex or csv; add one of them")
    if arguments.table is not None and arguments.output is not None:
        raise HeadwayError("--output has no effect with --table, which prints; omit one of them")
    (root, study), *others = named_studies(arguments.study, arguments.store).values()
    folder = Path(arguments.output or "-".join(["report", study, *(other for _, other in others)]))
    if arguments.table is None and folder.exists() and not folder.is_dir():
        raise HeadwayError(f"--output: {folder} is a file; name a folder")
    from headway_launch.report.study_data import StudyData
    from headway_launch.report.study_report import report_of

    metric, lower, where = arguments.metric, arguments.lower_is_better, arguments.where
    data = StudyData(root, study, metric, lower, arguments.low, others, where)
    report = report_of(data, typed_line(arguments))
    if arguments.table is not None:
        print(table_text(report, arguments.table, arguments.format), end="")
    else:
        print(write_report(report, folder, FORMATS[arguments.format]))
    return 0
