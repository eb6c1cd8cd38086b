"""The command ``compare``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from export_model.exporter.cli.console import Console, reporting
from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import (
    JUDGING,
    as_given,
    comparing,
    located,
    pairs,
    reading,
    reading_candidates,
    understanding,
)
from export_model.exporter.cli.rows import PATH

if TYPE_CHECKING:
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.source import ReadOptions
    from export_model.converters.policy.policy import Policy
    from export_model.exporter.verify.options import VerifyOptions


@command(
    "compare",
    "Compare files made by any tool with a reference.",
    ("export-model compare policy.pt policy.onnx", ""),
    ("export-model compare 3DBall.bytes tfjs --map action=Identity", ""),
    core=("mapped", "runtimes", "allow_unverified", "trust_source", "html", "junit", "as_json", "verbose", "quiet"),
)
@click.argument("reference", type=PATH)
@click.argument("candidates", nargs=-1, required=True, type=PATH, metavar="CANDIDATE...")
@click.option("--map", "mapped", multiple=True, metavar="NAME=OTHER", help="What the candidates call one of its names.")
@located
@click.option("--allow-unverified", is_flag=True, help="Succeed even if none of their runtimes is installed.")
@reporting
@reading_candidates
@understanding
@reading()
@comparing
def compare_command(
    reference: Path,
    candidates: tuple[Path, ...],
    mapped: tuple[str, ...],
    read: ReadOptions,
    candidate_read: ReadOptions,
    candidate_compiling: CompileOptions,
    runtimes: str,
    allow_unverified: bool,
    compiling: CompileOptions,
    console: Console,
    options: VerifyOptions,
) -> None:
    """Compare files made by any tool with a reference: graphs, SavedModels, TensorFlow.js, ONNX, bundles."""
    from msgspec.structs import replace

    from export_model.converters.files.fetch import path_text
    from export_model.exporter.compare.comparison import CompareOptions, compare_artefacts
    from export_model.exporter.reports.entry import Entry

    understood: list[Policy] = []
    with console.progress() as progress:
        report = compare_artefacts(
            reference,
            candidates,
            CompareOptions(
                names=pairs(mapped, "--map"),
                judging=replace(options, runtimes=runtimes),
                understanding=compiling,
                read=read,
                candidate_understanding=candidate_compiling,
                candidate_read=candidate_read,
                allow_unverified=allow_unverified,
            ),
            progress=progress,
            understood=understood.append,
        )
    console.report_policy(report, ", ".join(map(path_text, candidates)))
    console.json({"reports": [report.to_dict()]})
    command = ("compare", *map(path_text, (reference, *candidates)), *as_given(JUDGING))
    console.write_reports(
        lambda: [Entry(report, understood[0].signature, understood[0].graph, steps=options.steps, command=command)]
    )
    if report.passed is False:
        sys.exit(1)
    if report.undecided and not allow_unverified:
        sys.exit(3)
