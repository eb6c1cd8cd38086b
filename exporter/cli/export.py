"""The command ``export``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from export_model.exporter.cli.console import Console, reporting
from export_model.exporter.cli.group import command
from export_model.exporter.cli.guesses import answer_place
from export_model.exporter.cli.options import RULES, as_given, coding, comparing, located, reading, understanding
from export_model.exporter.cli.rows import PATH
from export_model.exporter.cli.terminal import say_lines

if TYPE_CHECKING:
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.source import ReadOptions
    from export_model.converters.policy.policy import Policy
    from export_model.exporter.export.options import ExportOptions
    from export_model.exporter.export.pipeline import ExportResult
    from export_model.exporter.markup import Markup
    from export_model.exporter.play.report import PlayReport
    from export_model.exporter.reports.entry import Entry
    from export_model.exporter.verify.options import VerifyOptions
    from export_model.signatures.code import CodeOptions
    from export_model.signatures.errors import ExportModelError


@command(
    "export",
    "Export policies to every format, and compare them.",
    ("export-model 3DBall.bytes -o out", "four formats, compared"),
    ("export-model results/first_run", "each behavior of a run"),
    ("export-model 3DBall.nn --to onnx", "one format"),
    ("export-model 3DBall.onnx --for unity6", "for the Model field"),
    ("export-model 3DBall.bytes --verify full", "in every runtime"),
    core=(
        *("out", "targets", "profile", "runtimes", "name", "deterministic"),
        *("html", "as_json", "jobs", "trust_source", "verbose", "quiet"),
    ),
)
@click.argument("sources", nargs=-1, type=PATH, metavar="SOURCE...")
@click.option("-o", "--out", type=PATH, default=Path("exported"), help="Folder for the bundles, or an address.")
@click.option("--to", "targets", metavar="FORMATS", help="bytes,saved_model,tfjs,onnx; or nn,litert,c,csharp,js.")
@click.option("--for", "profile", metavar="NAME", help="Make the files for a loader (unity6, …); 'help' lists all.")
@click.option("--name", metavar="NAME", help="The policy's name (default: the file's).")
@click.option(
    "--names",
    type=click.Choice(["canonical", "source"]),
    show_default="canonical",
    help="Tensor names: canonical, or the trainer's own.",
)
@click.option(
    "--noise",
    type=click.Choice(["lift", "keep", "zero"]),
    show_default="lift",
    help="Noise drawn in the graph: an input, kept, or removed.",
)
@click.option("--deterministic", is_flag=True, help="Make 'action' the deterministic one.")
@click.option(
    "--dtype",
    type=click.Choice(["float32", "float16"]),
    default="float32",
    help="The type that weights are stored in.",
)
@click.option("--quantize", type=click.Choice(["int8"]), help="Store each weight in one byte.")
@coding
@click.option("--batch", type=int, metavar="N", help="Write files for N agents at a time (ONNX, LiteRT).")
@click.option("--bake", type=click.Choice(["actions"]), help="Put the action's scale and offset into the graph.")
@click.option("--labels", type=PATH, metavar="FILE", help="Names of observations and actions.")
@click.option("--opset", type=int, metavar="N", help="ONNX opset (default: 15).")
@located
@click.option("--env", metavar="ENV", help="Play this environment with what was written (see play).")
@click.option("--jobs", type=int, metavar="N", help="Export N sources at a time (default: 1).")
@click.option("--cluster", metavar="ADDRESS", help="Export on the workers of a Dask cluster.")
@click.option("--again", is_flag=True, help="With many sources, export unchanged ones too.")
@click.option("--fail-fast", is_flag=True, help="With many sources, stop at the first failure.")
@reporting
@understanding
@reading()
@comparing
def export_command(
    sources: tuple[Path, ...],
    out: Path,
    targets: str | None,
    profile: str | None,
    name: str | None,
    opset: int | None,
    runtimes: str,
    read: ReadOptions,
    labels: Path | None,
    dtype: str,
    quantize: str | None,
    batch: int | None,
    code: CodeOptions,
    bake: str | None,
    env: str | None,
    jobs: int | None,
    cluster: str | None,
    again: bool,
    fail_fast: bool,
    compiling: CompileOptions,
    console: Console,
    options: VerifyOptions,
) -> None:
    """Export policies, and compare what was written in the installed runtimes.

    This is the default command: 'export-model SOURCE' runs it.
    """
    from export_model.exporter.export.options import ExportOptions, storage

    if profile == "help":
        console.profiles()
        return
    console.check_verified(runtimes)
    answer_place(sources, out)
    job = ExportOptions(
        out=out,
        targets=None if targets is None else [t for t in targets.split(",") if t],
        name=name,
        compile=compiling,
        read=read,
        opset=opset,
        verify=runtimes,
        parity=options,
        labels=labels,
        profile=profile,
        weights=storage(dtype, quantize),
        batch=batch,
        code=code,
        bake=bake,
    )
    many = again or fail_fast or cluster is not None or _are_many(sources, job)
    if jobs is not None:  # of one source they say nothing, but what is wrong with them is said
        many = many or jobs < 1 or len(sources) != 1
    if env is not None:
        _check_playable(env, 2 if many or jobs is not None else len(sources), runtimes, profile, bake)
    if many:
        from export_model.exporter.cli.fleet import run_fleet

        run_fleet(sources, job, jobs=jobs, cluster=cluster, again=again, fail_fast=fail_fast, console=console)
    else:
        _export_few(sources, job, env, console)


def _are_many(sources: Sequence[Path], job: ExportOptions) -> bool:
    """Whether a fleet exports them: folders, globs and lists, or bundles that are sent to an address."""
    from export_model.converters.files.fetch import address_of
    from export_model.exporter.fleet.sources import is_many

    return is_many(sources, job.read) or address_of(job.out) is not None


def _export_few(sources: Sequence[Path], job: ExportOptions, env: str | None, console: Console) -> None:
    """Export sources in this process, and leave with the status of what came of it."""

    def check_fit(policies: Sequence[Policy]) -> None:
        for policy in policies:
            console.note_size(policy, job)
        if env is not None:
            from export_model.exporter.play.named import world_maker

            for policy in policies:
                world_maker(env, sources[0])(policy.signature)

    results, refused = _export_all(sources, job, console, check_fit)
    played: list[PlayReport] = [] if env is None else _play(env, sources[0], results, job, console)
    results = [_with_played(result, played) for result in results]
    told: dict[str, object] = {"refused": [e.to_dict() for e in refused]} if refused else {}
    told |= {"play": [p.to_dict() for p in played]} if played else {}
    console.json({"policies": [r.to_dict() for r in results], **told})
    console.write_reports(lambda: _entries(results, job.parity.steps, played), refused)
    console.next_step(results, job.compile.names, job.profile, sources)
    status = 2 if refused else _status(results, played)
    if status:
        sys.exit(status)


def _status(results: Sequence[ExportResult], played: Sequence[PlayReport]) -> int:
    """Return 1 where formats disagree or play otherwise, 3 where a report is undecided, else 0."""
    if any(r.passed is False for r in results) or any(p.passed is False for p in played):
        return 1
    return 3 if any(r.report is not None and r.report.undecided for r in results) else 0


def _export_all(
    sources: Sequence[Path], job: ExportOptions, console: Console, understood: Callable[[Sequence[Policy]], object]
) -> tuple[list[ExportResult], list[ExportModelError]]:
    """Export sources one after the other, and print what came of each; return the results and what was refused."""
    from export_model.exporter.export.pipeline import export

    results: list[ExportResult] = []
    refused: list[ExportModelError] = []
    with console.progress() as progress:

        def refuse(error: ExportModelError) -> None:
            refused.append(error)
            progress.clear()
            say_lines(f"error: {error.message}", err=True)

        for result in export(list(sources), job, progress, refused=refuse, understood=understood):
            results.append(result)
            progress.clear()
            console.print_result(result)
    console.print_summary([r.report for r in results if r.report is not None], refused=len(refused))
    return results, refused


def _check_playable(env: str, sources: int, runtimes: str, profile: str | None, bake: str | None) -> None:
    """Raise UsageError where what is exported cannot play, before anything takes long."""
    from export_model.exporter.play.named import world_maker
    from export_model.signatures.errors import UsageError

    if sources != 1:
        raise UsageError("--env goes with a single source", fix="export-model play BUNDLE --env plays one bundle")
    if profile is not None:
        raise UsageError(
            f"--env does not go with --for {profile}",
            why="files with the names of --for lack outputs that are compared in play",
            fix="export without --for to play; --for is held against the source by its numbers",
        )
    if bake is not None:
        raise UsageError(
            "--env does not go with --bake", why="the source acts in other numbers", fix="leave one of them out"
        )
    if runtimes == "none":
        raise UsageError("--env needs runtimes", why="--verify none was given", fix="leave one of them out")
    world_maker(env, Path())


def _play(
    env: str, source: Path, results: Sequence[ExportResult], job: ExportOptions, console: Console
) -> list[PlayReport]:
    """Play with each bundle whose formats agree; the source is the reference of the only one."""
    from export_model.exporter.play.play import play_policy
    from export_model.exporter.play.record import keep_record
    from export_model.exporter.verify.options import VerifyOptions

    judging = VerifyOptions(runtimes=job.verify, rules=job.parity.rules)
    played = []
    for result in results:
        if result.passed is False:
            continue
        reference = source if len(results) == 1 else result.folder
        with console.progress() as progress:
            report = play_policy(
                reference,
                env,
                result.folder,
                understanding=job.compile,
                read=job.read,
                judging=judging,
                progress=progress,
            )
        report = keep_record(result.folder, report)
        console.report_play(report)
        played.append(report)
    return played


def _with_played(result: ExportResult, played: Sequence[PlayReport]) -> ExportResult:
    """Return a result whose report has what was played with it."""
    from msgspec.structs import replace

    own = tuple(p.record for p in played if p.policy == result.policy.name)
    if result.report is None or not own:
        return result
    return replace(result, report=replace(result.report, played=own))


def _entries(results: Sequence[ExportResult], steps: int, played: Sequence[PlayReport]) -> list[Entry]:
    from msgspec.structs import replace

    from export_model.exporter.reports.entry import of_result

    words, found = as_given(RULES), []
    for result in results:
        entry = of_result(result, steps, words)
        if entry is not None:
            found.append(replace(entry, more=_pictures(p for p in played if p.policy == entry.name)))
    return found


def _pictures(played: Iterable[PlayReport]) -> tuple[Markup, ...]:
    """Return the sections of a page on what was played; nothing is imported where nothing was."""
    found = list(played)
    if not found:
        return ()
    from export_model.exporter.play.documents import returns_section

    return tuple(returns_section(report) for report in found)
