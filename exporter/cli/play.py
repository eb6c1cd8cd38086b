"""The command ``play``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from export_model.exporter.cli.console import Console, reporting
from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import located, pairs, reading, understanding
from export_model.exporter.cli.rows import PATH

if TYPE_CHECKING:
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.source import ReadOptions


@command(
    "play",
    "Play an environment: does every format earn the same?",
    ("export-model play exported/3DBall --env 3DBall", "every format"),
    ("export-model play 3DBall.bytes theirs.onnx --env 3DBall", "a file of any tool"),
    core=(
        "env",
        "episodes",
        "margin",
        "likeliest",
        "strict",
        "partner",
        "runtimes",
        "seed",
        "as_json",
        "verbose",
        "quiet",
    ),
)
@click.argument("reference", type=PATH)
@click.argument("candidates", nargs=-1, type=PATH, metavar="[CANDIDATE]...")
@click.option("--env", required=True, metavar="ENV", help="3DBall and others of ours, a Gymnasium id, or module:make.")
@click.option("--episodes", type=int, default=200, metavar="N", help="Episodes that each plays, 20 or more.")
@click.option("--most", type=int, default=12_800, metavar="N", help="Play up to N others where these do not decide.")
@click.option("--seed", type=int, default=0, metavar="N", help="Seed of the episodes and of drawn actions.")
@click.option("--margin", default="1%", metavar="SIZE", help="How far mean returns may be apart: 1%, or a number.")
@click.option(
    "--deterministic", "likeliest", is_flag=True, help="Take the likeliest action and the mean, in place of draws."
)
@click.option("--strict", is_flag=True, help="Fail where more episodes are needed to decide, too.")
@click.option("--partner", type=PATH, metavar="BUNDLE", help="Who plays the other side, where there is one.")
@click.option("--map", "mapped", multiple=True, metavar="NAME=OTHER", help="What the candidates call one of its names.")
@located
@reporting
@understanding
@reading("trust_source", "sensors", "activation", "script")
def play_command(
    reference: Path,
    candidates: tuple[Path, ...],
    env: str,
    episodes: int,
    most: int,
    seed: int,
    margin: str,
    likeliest: bool,
    strict: bool,
    partner: Path | None,
    mapped: tuple[str, ...],
    read: ReadOptions,
    runtimes: str,
    compiling: CompileOptions,
    console: Console,
) -> None:
    """Play an environment with every format in the installed runtimes, and compare what they earn.

    Each is fed the states that the reference met, step by step; then each plays whole episodes from the same seeds.
    Without a candidate, the formats of the bundle play, or those that an export of the source would write.
    """
    from export_model.exporter.play.options import PlayOptions
    from export_model.exporter.play.play import play_policy
    from export_model.exporter.verify.options import VerifyOptions

    options = PlayOptions(episodes, seed, margin, likeliest, most)
    with console.progress() as progress:
        report = play_policy(
            reference,
            env,
            candidates,
            options=options,
            partner=partner,
            names=pairs(mapped, "--map"),
            understanding=compiling,
            read=read,
            judging=VerifyOptions(runtimes=runtimes, rules=console.rules()),
            progress=progress,
        )
    console.check_rules([report.replay])
    console.report_play(report)
    console.json(report.to_dict())
    if console.wants_reports:
        from export_model.exporter.play.documents import play_documents

        console.write_documents(play_documents(report))
    if report.passed is False or (strict and report.passed is None):
        sys.exit(1)
