"""The command line. Imports click only; everything else is imported by the command that needs it."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from exporter.version import __version__
from signatures.errors import ExportModelError, UsageError

if TYPE_CHECKING:
    from converters.graph.options import CompileOptions
    from exporter.parity.report import ParityReport
    from exporter.parity.subject import VerifyOptions
    from exporter.pipeline import ExportResult

_TARGETS = "bytes,saved_model,tfjs,onnx"


class _DefaultGroup(click.Group):
    """``export-model FILE`` is ``export-model export FILE``: anything that is not a command is a source."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        first = next((a for a in args if not a.startswith("-")), None)
        own = {"--help", "-h", "--version"}
        if args and (first is None or args[0] not in self.commands) and args[0] not in own:
            args = ["export", *args]
        return super().parse_args(ctx, args)

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_usage(ctx.command_path, "SOURCE... [-o DIR] [OPTIONS]")
        formatter.write_usage(ctx.command_path, "COMMAND ...", prefix="       ")


@click.group(
    cls=_DefaultGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Export trained Unity ML-Agents policies to .bytes, SavedModel, TensorFlow.js and ONNX, and prove by running "
    "them that all agree. 'export-model SOURCE' exports; see the commands for the rest.",
)
@click.version_option(__version__, prog_name="export-model")
def app() -> None:
    """The group; its commands do the work."""


def _pairs(values: Sequence[str], flag: str) -> dict[str, str]:
    pairs = {}
    for value in values:
        name, equals, rest = value.partition("=")
        if not equals or not name or not rest:
            raise UsageError(f"{flag} {value}: NAME=VALUE is expected")
        pairs[name] = rest
    return pairs


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
        click.option("--atol", type=float, default=1e-5, show_default=True, help="Absolute tolerance."),
        click.option("--rtol", type=float, default=1e-5, show_default=True, help="Relative tolerance."),
    ):
        command = option(command)
    return command


def _verify_options(seed: int, samples: int, steps: int, atol: float, rtol: float) -> VerifyOptions:
    from exporter.parity.subject import VerifyOptions
    from exporter.parity.tolerances import Tolerance

    return VerifyOptions(seed, samples, steps, Tolerance(atol, rtol))


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
@click.option("--opset", type=int, default=15, show_default=True, help="ONNX opset.")
@click.option(
    "--verify",
    "runtimes",
    default="auto",
    show_default=True,
    metavar="auto|none|full|RUNTIME,...",
    help="Runtimes to compare in.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
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
    as_json: bool,
    step: int | None,
    brain: str | None,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    values: tuple[str, ...],
    seed: int,
    samples: int,
    steps: int,
    atol: float,
    rtol: float,
) -> None:
    """Export policies (the command that is meant where none is named)."""
    from converters.source import ReadOptions
    from exporter.pipeline import ExportOptions, export

    options = ExportOptions(
        out,
        [t for t in targets.split(",") if t],
        name,
        _compile_options(brain, inputs, outputs, values, names=names, noise=noise, deterministic=deterministic),
        ReadOptions(step),
        opset,
        runtimes,
        _verify_options(seed, samples, steps, atol, rtol),
    )
    results = []
    for result in export(list(sources), options, _progress(as_json)):
        results.append(result)
        if not as_json:
            _print_result(result)
    if as_json:
        click.echo(json.dumps({"policies": [_result_dict(r) for r in results]}, indent=1))
    else:
        _print_next(results, options.compile.names, options.targets)
    if any(r.passed is False for r in results):
        sys.exit(1)


def _progress(quiet: bool) -> Callable[[str], None]:
    """One line that is overwritten, on a terminal only."""
    if quiet or not sys.stderr.isatty():
        return lambda text: None
    return lambda text: click.echo(f"\r\x1b[2K  {text[:100]}", nl=False, err=True)


def _print_result(result: ExportResult) -> None:
    from exporter.summary import failure_lines, not_run_lines, parity_table, verdict
    from exporter.tables import size_text, table

    if sys.stderr.isatty():
        click.echo("\r\x1b[2K", nl=False, err=True)
    signature = result.policy.signature
    click.echo(f"{result.policy.name}: {signature.family}, {signature.action_space} actions -> {result.folder}")
    for note in signature.notes:
        click.echo(f"  note: {note}")
    if result.report is None:
        rows = [[kind, size_text(size)] for kind, size in result.sizes.items()]
        click.echo(table(("format", "size"), rows))
        click.echo("NOT VERIFIED: --verify none")
        return
    _print_report(result.report, parity_table, failure_lines, not_run_lines, verdict)


def _print_report(
    report: ParityReport,
    parity_table: Callable[[ParityReport], str],
    failure_lines: Callable[[ParityReport], list[str]],
    not_run_lines: Callable[[ParityReport], list[str]],
    verdict: Callable[[ParityReport], str],
) -> None:
    click.echo(parity_table(report))
    for line in [*failure_lines(report), *not_run_lines(report)]:
        click.echo(line)
    colour = {True: "green", False: "red", None: "yellow"}[report.passed]
    click.secho(verdict(report), fg=colour)


def _print_next(results: Sequence[ExportResult], names: str, targets: Sequence[str]) -> None:
    """What to do next, in a line or two."""
    if not results:
        return
    failed = next((r for r in results if r.passed is False), None)
    if failed is not None:
        click.echo(f"next: read {failed.folder}/parity.json; the bundle was kept apart because its formats disagree")
        return
    if "bytes" in targets and names == "canonical":
        click.echo("note: Unity looks nodes up by the trainer's names: export with --names source for Unity")
    click.echo(f"next: export-model verify {results[-1].folder}    (policy.json there says what to feed)")


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
@_understanding
def inspect_command(
    source: Path,
    as_json: bool,
    brain: str | None,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    values: tuple[str, ...],
) -> None:
    """Show what is in a file: generation, brains, inputs and what to feed, outputs, ops, targets."""
    from exporter.inspection import inspect_source, inspection_text

    found = inspect_source(source, _compile_options(brain, inputs, outputs, values))
    if as_json:
        click.echo(json.dumps(found.to_dict(), indent=1))
        return
    click.echo(inspection_text(found))
    click.echo(f"next: export-model {source} -o exported")


@app.command("verify")
@click.argument("bundles", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="BUNDLE...")
@click.option("--source", type=click.Path(path_type=Path), help="The file the bundle was exported from.")
@click.option(
    "--runtimes", default="auto", show_default=True, metavar="auto|full|RUNTIME,...", help="Runtimes to compare in."
)
@click.option("--allow-unverified", is_flag=True, help="Succeed although no independent runtime is installed.")
@click.option("--json", "as_json", is_flag=True, help="Print the reports as JSON.")
@_parity_options
def verify_command(
    bundles: tuple[Path, ...],
    source: Path | None,
    runtimes: str,
    allow_unverified: bool,
    as_json: bool,
    seed: int,
    samples: int,
    steps: int,
    atol: float,
    rtol: float,
) -> None:
    """Verify bundles again: hashes first, then every format in the runtimes."""
    from exporter.pipeline import verify_folder
    from exporter.summary import failure_lines, not_run_lines, parity_table, verdict

    reports = []
    for folder in bundles:
        report = verify_folder(
            folder,
            source=source,
            runtimes=runtimes,
            options=_verify_options(seed, samples, steps, atol, rtol),
            allow_unverified=allow_unverified,
            progress=_progress(as_json),
        )
        reports.append(report)
        if not as_json:
            click.echo(f"{report.policy}: {folder}")
            for note in report.notes:
                click.echo(f"  note: {note}")
            _print_report(report, parity_table, failure_lines, not_run_lines, verdict)
    if as_json:
        click.echo(json.dumps({"reports": [r.to_dict() for r in reports]}, indent=1))
    if any(r.passed is False for r in reports):
        sys.exit(1)


@app.group("runtimes", invoke_without_command=True)
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def runtimes_command(ctx: click.Context, as_json: bool) -> None:
    """Which runtimes are here, in which version, and how to install the others."""
    if ctx.invoked_subcommand is not None:
        return
    from exporter.runtimes import available_runtimes
    from exporter.tables import table

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
    from exporter.runtimes import RUNTIMES

    chosen = [r for r in RUNTIMES if r.name == name or r.name.startswith((f"{name}-", f"{name}."))]
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
