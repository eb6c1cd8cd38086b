"""The command line. Imports click only; everything else is imported by the command that needs it."""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from exporter.cli.console import Console, reporting
from exporter.cli.group import SourceGroup, completion_command, show_version
from exporter.serve.command import serve_command
from exporter.snippets.command import snippets_command
from signatures.errors import ExportModelError, UsageError

if TYPE_CHECKING:
    from converters.graph.options import CompileOptions
    from exporter.export.pipeline import ExportResult
    from exporter.reports.entry import Entry
    from exporter.verify.report import ParityReport
    from exporter.verify.subject import VerifyOptions

_TARGETS = "bytes,saved_model,tfjs,onnx"


@click.group(
    cls=SourceGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Export trained Unity ML-Agents policies to .bytes, SavedModel, TensorFlow.js and ONNX, and prove by running "
    "them that all agree. 'export-model SOURCE' exports; see the commands for the rest.",
)
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=show_version,
    help="Show the version, and the runtimes that are here.",
)
def app() -> None:
    """The group; its commands do the work."""


app.add_command(completion_command)


def _pairs(values: Sequence[str], flag: str) -> dict[str, str]:
    pairs = {}
    for value in values:
        name, equals, rest = value.partition("=")
        if not equals or not name or not rest:
            raise UsageError(f"{flag} {value}: NAME=VALUE is expected", fix=f"for example {flag} action=Identity")
        pairs[name] = rest
    return pairs


def _shapes(text: str) -> tuple[tuple[int, ...], ...]:
    """``"8,3x84x84"`` as the shapes of a vector of 8 and an image C, H, W."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if not re.fullmatch("[1-9][0-9]{0,6}(x[1-9][0-9]{0,6}x[1-9][0-9]{0,6})?", part):
            raise UsageError(
                f"--sensors {text}: {part} is no shape of a sensor",
                fix="give one shape per sensor: 8 for a vector, 3x84x84 (channels, height, width) for an image",
            )
    return tuple(tuple(int(n) for n in part.split("x")) for part in parts)


def _numbers(values: Sequence[str]) -> dict[str, float]:
    numbers = {}
    words = {"true": 1.0, "false": 0.0}
    for name, text in _pairs(values, "--set").items():
        try:
            numbers[name] = words[text.lower()] if text.lower() in words else float(text)
        except ValueError as error:
            raise UsageError(f"--set {name}={text}: a number, true or false is expected") from error
    return numbers


def _understanding(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that decide what inference cannot."""
    for option in (
        click.option("--brain", metavar="NAME", help="Only this brain of a graph that holds several."),
        click.option("--input", "inputs", multiple=True, metavar="N=ROLE", help="Say what an input is for."),
        click.option("--output", "outputs", multiple=True, metavar="N=ROLE", help="Say what an output is."),
        click.option("--set", "values", multiple=True, metavar="N=VALUE", help="Give a placeholder a fixed value."),
    ):
        command = option(command)
    return command


def _parity_options(command: Callable[..., Any]) -> Callable[..., Any]:
    for option in (
        click.option(
            "--samples", type=click.IntRange(1), default=2, show_default=True, help="Typical inputs per batch size."
        ),
        click.option("--seed", type=int, default=0, show_default=True, help="Seed of the inputs."),
        click.option(
            "--steps", type=click.IntRange(1), default=4, show_default=True, help="Steps with the memory fed back."
        ),
        click.option("--max-size", "sizes", multiple=True, metavar="[FORMAT=]SIZE", help="Fail above this size: 1MB."),
        click.option(
            "--golden",
            type=click.Path(path_type=Path, dir_okay=False),
            metavar="FILE",
            help="Recorded inputs (and outputs), an .npz.",
        ),
        click.option("--atol", type=float, default=1e-5, show_default=True, help="Absolute tolerance."),
        click.option("--rtol", type=float, default=1e-5, show_default=True, help="Relative tolerance."),
    ):
        command = option(command)
    return command


def _verify_options(
    console: Console,
    *,
    seed: int,
    samples: int,
    steps: int,
    atol: float,
    rtol: float,
    golden: Path | None,
    sizes: Sequence[str],
) -> VerifyOptions:
    from exporter.verify.budget import parse_budget
    from exporter.verify.subject import VerifyOptions
    from exporter.verify.tolerances import Tolerance

    return VerifyOptions(seed, samples, steps, Tolerance(atol, rtol), console.rules(), golden, parse_budget(sizes))


def _compile_options(
    brain: str | None, inputs: Sequence[str], outputs: Sequence[str], values: Sequence[str], **rest: Any
) -> CompileOptions:
    from exporter.api import _compile_options as build

    return build(
        rest.get("names", "canonical"),
        rest.get("noise", "lift"),
        bool(rest.get("deterministic", False)),
        brain,
        _pairs(inputs, "--input"),
        _pairs(outputs, "--output"),
        _numbers(values),
    )


@app.command("export")
@click.argument("sources", nargs=-1, type=click.Path(path_type=Path), metavar="SOURCE...")
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path),
    default=Path("exported"),
    show_default=True,
    help="Folder for the bundles.",
)
@click.option("--to", "targets", default=_TARGETS, show_default=True, metavar="FORMATS", help="Formats to write.")
@click.option("--name", metavar="NAME", help="The policy's name (default: the file's).")
@click.option(
    "--names",
    type=click.Choice(["canonical", "source"]),
    default="canonical",
    show_default=True,
    help="Tensor names: canonical, or the trainer's own (Unity looks those up).",
)
@click.option(
    "--noise",
    type=click.Choice(["lift", "keep", "zero"]),
    default="lift",
    show_default=True,
    help="Noise drawn in the graph: an input, kept, or removed.",
)
@click.option("--deterministic", is_flag=True, help="Make 'action' the one without chance.")
@click.option("--step", type=int, metavar="N", help="The checkpoint of this step (default: the newest).")
@click.option("--sensors", default="", metavar="SHAPE,...", help="What the agent of a .pt observes: 8,3x84x84.")
@click.option("--labels", type=click.Path(path_type=Path), metavar="FILE", help="Names of observations and actions.")
@click.option("--opset", type=int, default=15, show_default=True, help="ONNX opset.")
@click.option(
    "--verify",
    "runtimes",
    default="auto",
    show_default=True,
    metavar="auto|none|full|RUNTIME,...",
    help="Runtimes to compare in.",
)
@reporting
@_understanding
@_parity_options
def export_command(
    sources: tuple[Path, ...],
    out: Path,
    targets: str,
    name: str | None,
    names: str,
    noise: str,
    deterministic: bool,
    opset: int,
    runtimes: str,
    step: int | None,
    sensors: str,
    labels: Path | None,
    brain: str | None,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    values: tuple[str, ...],
    console: Console,
    **parity: Any,
) -> None:
    """Export policies (the command that is meant where none is named)."""
    from converters.source import ReadOptions
    from exporter.export.pipeline import ExportOptions, export

    console.prepare(verifies=runtimes != "none")
    options = ExportOptions(
        out,
        [t for t in targets.split(",") if t],
        name,
        _compile_options(brain, inputs, outputs, values, names=names, noise=noise, deterministic=deterministic),
        ReadOptions(step, _shapes(sensors)),
        opset,
        runtimes,
        _verify_options(console, **parity),
        labels,
    )
    results = []
    with console.progress() as progress:
        for result in export(list(sources), options, progress):
            results.append(result)
            progress.clear()
            console.result(result)
    console.check_rules([r.report for r in results if r.report is not None])
    console.json({"policies": [_result_dict(r) for r in results]})
    console.next_step(results, options.compile.names, options.targets)
    console.write_reports(lambda: _entries(results, parity["steps"]))
    if any(r.passed is False for r in results):
        sys.exit(1)


def _entries(results: Sequence[ExportResult], steps: int) -> list[Entry]:
    from exporter.reports.entry import of_result

    return [entry for entry in (of_result(result, steps) for result in results) if entry is not None]


def _result_dict(result: ExportResult) -> dict[str, Any]:
    return {
        "name": result.policy.name,
        "folder": str(result.folder),
        "passed": result.passed,
        "sizes": dict(result.sizes),
        "parity": None if result.report is None else result.report.to_dict(),
    }


@app.command("inspect")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.option("--step", type=int, metavar="N", help="The checkpoint of this step (default: the newest).")
@click.option("--logdir", type=click.Path(path_type=Path), metavar="DIR", help="Write its graph for TensorBoard.")
@click.option("--svg", type=click.Path(path_type=Path), metavar="FILE", help="Write a picture of the policy.")
@click.option("--sensors", default="", metavar="SHAPE,...", help="What the agent of a .pt observes: 8,3x84x84.")
@_understanding
def inspect_command(
    source: Path,
    step: int | None,
    sensors: str,
    as_json: bool,
    logdir: Path | None,
    svg: Path | None,
    brain: str | None,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    values: tuple[str, ...],
) -> None:
    """Show what is in a file: generation, brains, inputs and what to feed, outputs, ops, targets."""
    from converters.source import ReadOptions
    from exporter.inspect.inspection import inspect_source, inspection_text

    found = inspect_source(
        source, _compile_options(brain, inputs, outputs, values), ReadOptions(step, _shapes(sensors))
    )
    written: list[Path] = []
    if logdir is not None or svg is not None:
        from exporter.inspect.pictures import write_pictures

        written = write_pictures(found, logdir, svg)
    if as_json:
        shown = {"written": [str(path) for path in written]} if written else {}
        click.echo(json.dumps({**found.to_dict(), **shown}, indent=1))
        return
    click.echo(inspection_text(found))
    for path in written:
        click.echo(f"wrote {path}")
    click.echo(f"next: export-model {source}{'' if step is None else f' --step {step}'} -o exported")


@app.command("verify")
@click.argument("bundles", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="BUNDLE...")
@click.option("--source", type=click.Path(path_type=Path), help="The file the bundle was exported from.")
@click.option("--step", type=int, metavar="N", help="The source's checkpoint (default: the one of the export).")
@click.option(
    "--runtimes", default="auto", show_default=True, metavar="auto|full|RUNTIME,...", help="Runtimes to compare in."
)
@click.option("--allow-unverified", is_flag=True, help="Succeed although no independent runtime is installed.")
@reporting
@_parity_options
def verify_command(
    bundles: tuple[Path, ...],
    source: Path | None,
    step: int | None,
    runtimes: str,
    allow_unverified: bool,
    console: Console,
    **parity: Any,
) -> None:
    """Verify bundles again: hashes first, then every format in the runtimes."""
    from exporter.export.pipeline import verify_folder

    console.prepare()
    options = _verify_options(console, **parity)
    reports = []
    with console.progress() as progress:
        for folder in bundles:
            report = verify_folder(
                folder,
                source=source,
                step=step,
                runtimes=runtimes,
                options=options,
                allow_unverified=allow_unverified,
                progress=progress,
            )
            reports.append(report)
            progress.clear()
            console.verified(report, folder)
    console.check_rules(reports)
    console.json({"reports": [r.to_dict() for r in reports]})
    console.write_reports(lambda: _bundle_entries(reports, bundles, parity["steps"]))
    if any(r.passed is False for r in reports):
        sys.exit(1)


def _bundle_entries(reports: Sequence[ParityReport], bundles: Sequence[Path], steps: int) -> list[Entry]:
    from exporter.reports.entry import of_bundle

    return [of_bundle(report, folder, steps) for report, folder in zip(reports, bundles, strict=True)]


@app.command("compare")
@click.argument("reference", type=click.Path(path_type=Path))
@click.argument("candidates", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CANDIDATE...")
@click.option("--map", "names", multiple=True, metavar="NAME=OTHER", help="What the candidates call a name.")
@click.option(
    "--runtimes", default="auto", show_default=True, metavar="auto|full|RUNTIME,...", help="Runtimes to compare in."
)
@click.option("--allow-unverified", is_flag=True, help="Succeed although no runtime of theirs is installed.")
@reporting
@_understanding
@_parity_options
def compare_command(
    reference: Path,
    candidates: tuple[Path, ...],
    names: tuple[str, ...],
    runtimes: str,
    allow_unverified: bool,
    brain: str | None,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    values: tuple[str, ...],
    console: Console,
    **parity: Any,
) -> None:
    """Hold artefacts that any tool made against a reference: graphs, SavedModels, TensorFlow.js, ONNX, bundles."""
    from exporter.compare.comparison import compare_artefacts
    from exporter.reports.entry import Entry

    console.prepare()
    with console.progress() as progress:
        report = compare_artefacts(
            reference,
            candidates,
            names=_pairs(names, "--map"),
            runtimes=runtimes,
            options=_verify_options(console, **parity),
            understanding=_compile_options(brain, inputs, outputs, values),
            allow_unverified=allow_unverified,
            progress=progress,
        )
    console.verified(report, ", ".join(map(str, candidates)))
    console.check_rules([report])
    console.json({"reports": [report.to_dict()]})
    console.write_reports(lambda: [Entry(report, steps=parity["steps"])])
    if report.passed is False:
        sys.exit(1)


@app.group("runtimes", invoke_without_command=True)
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def runtimes_command(ctx: click.Context, as_json: bool) -> None:
    """Which runtimes are here, in which version, and how to install the others."""
    if ctx.invoked_subcommand is not None:
        return
    from converters.runtimes.registry import available_runtimes
    from exporter.cli.tables import table

    found = available_runtimes()
    if as_json:
        rows = [{"name": i.name, "installed": i.installed, "version": i.version, "install": i.how} for i in found]
        click.echo(json.dumps({"runtimes": rows}, indent=1))
        return
    cells = [[i.name, i.version or "-", "installed" if i.installed else i.how] for i in found]
    click.echo(table(("runtime", "version", "state"), cells))


@runtimes_command.command("install")
@click.argument("name")
def install_command(name: str) -> None:
    """Install a runtime into the user's cache folder; "tfjs" and "tf1" stand for all whose names begin so."""
    from converters.runtimes.registry import RUNTIMES

    chosen = [r for r in RUNTIMES if r.name == name]
    chosen = chosen or [r for r in RUNTIMES if r.name.startswith((f"{name}-", f"{name}."))]
    steps = list(dict.fromkeys(r.install for r in chosen if r.install is not None))
    if steps:
        for install in steps:
            install(lambda text: click.echo(text))
        return
    how = {r.name: r.find().how for r in chosen}.get(name)
    raise UsageError(
        f"runtimes install {name}: "
        + ("there is no such runtime" if how is None else "this command does not install it"),
        fix=how or "export-model runtimes lists the runtimes and how to install each",
    )


app.add_command(serve_command)
app.add_command(snippets_command)


def main(args: Sequence[str] | None = None) -> None:
    """Entry point: runs a command and turns errors into one message and an exit status."""
    wants_json = "--json" in (sys.argv[1:] if args is None else args)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a Windows console, or a pipe there, has no Δ
    try:
        app.main(args=None if args is None else list(args), prog_name="export-model", standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.Abort:
        click.echo("stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        if wants_json:
            click.echo(json.dumps(UsageError(error.format_message(), fix="export-model --help").to_dict(), indent=1))
        error.show()
        sys.exit(2)
    except ExportModelError as error:
        if wants_json:
            click.echo(json.dumps(error.to_dict(), indent=1))
        click.echo(f"error: {error.message}", err=True)
        sys.exit(error.exit_status)
    except OSError as error:  # of the terminal or the pipe; files have errors of their own
        click.echo(f"error: {error}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
