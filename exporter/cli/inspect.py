"""The command ``inspect``. Imports click only; the rest when it runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from export_model.exporter.cli.export import export_command
from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import as_given, reading, understanding
from export_model.exporter.cli.rows import FILE, PATH
from export_model.exporter.cli.terminal import say, say_json, say_lines, say_next
from export_model.signatures.errors import ExportModelError, UsageError

if TYPE_CHECKING:
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.source import ReadOptions


#: What only our readers are told.
_READERS = ("step", "activation", "script", "repair", "normaliser", "interface", "trust_source")
_UNTOLD = {"trust_source": False}


@command(
    "inspect",
    "Show what is in a file, or what Unity would say about it.",
    ("export-model inspect 3DBall.nn", "inputs, outputs, layers"),
    ("export-model inspect 3DBall.onnx --unity all", "what ML-Agents says to it"),
    ("export-model inspect 3DBall.nn --svg 3DBall.svg", "a picture"),
    core=("releases", "why", "svg", "step", "trust_source", "as_json"),
)
@click.argument("sources", nargs=-1, required=True, type=PATH, metavar="SOURCE...")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.option("--why", is_flag=True, help="Say which rule decided what each tensor is for.")
@click.option("--logdir", type=PATH, metavar="DIR", help="Write its graph for TensorBoard.")
@click.option("--svg", type=PATH, metavar="FILE", help="Draw the policy (with --unity: Behavior Parameters).")
@click.option(
    "--unity",
    "releases",
    multiple=True,
    metavar="RELEASE",
    help="Unity's answer: R20, R22, R23, R23-2.4, all; 2.0.1 … 1.0.8.",
)
@click.option("--actions", metavar="KINDS", help="With --unity: continuous:2, discrete:3,2, or both by +.")
@click.option(
    "--brain-parameters",
    type=FILE,
    metavar="FILE",
    help="With --unity: the agent's sensors and actions, as JSON.",
)
@understanding
@reading()
def inspect_command(
    sources: tuple[Path, ...],
    read: ReadOptions,
    releases: tuple[str, ...],
    actions: str | None,
    brain_parameters: Path | None,
    as_json: bool,
    why: bool,
    logdir: Path | None,
    svg: Path | None,
    compiling: CompileOptions,
) -> None:
    """Show what is in a file: generation, brains, inputs and what to feed, outputs, layers, targets.

    With --unity, what ML-Agents in Unity says about it instead; the status is 1 if a release does not accept it.
    """
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.files.fetch import path_text
    from export_model.exporter.remote.fetching import nearby

    if len(sources) > 1:
        _check_alone(logdir, svg)
    if not releases and (actions or brain_parameters is not None):
        raise UsageError("--actions and --brain-parameters are for --unity", fix="name a release: --unity R22")
    if releases:
        _check_looked_at(
            {
                "--logdir": logdir is not None,
                "--why": why,
                **{f"--{n.replace('_', '-')}": getattr(read, n) is not _UNTOLD.get(n) for n in _READERS},
                "--brain, --input, --output or --set": compiling != CompileOptions(),
            }
        )
    status, found = 0, list[dict[str, Any]]()
    for source in sources:
        try:
            with nearby(source) as here:
                if releases:
                    verdict, report = _unity(
                        here,
                        releases,
                        (click.get_current_context().params["sensors"], actions, brain_parameters),
                        as_json,
                        svg,
                    )
                    status = max(status, verdict)
                    found.append(report)
                else:
                    found.append(_inspect_source(here, compiling, read, logdir, svg, as_json=as_json, why=why))
                    status = 2 if "refused" in found[-1] else status
        except ExportModelError as error:
            if len(sources) == 1:
                raise
            say_lines(f"error: {error.message}", err=True)
            found.append({"path": path_text(source), **error.to_dict()})
            status = 2
    if as_json:
        say_json(found[0] if len(sources) == 1 else {"sources": found})
    _end(status, () if as_json or releases else sources)


def _end(status: int, sources: Sequence[Path]) -> None:
    """End with the status, or say what to do next with the sources."""
    if status:
        sys.exit(status)
    if sources:
        _propose_export(sources)


def _check_alone(logdir: Path | None, svg: Path | None) -> None:
    """Raise UsageError for options that write what one source has."""
    if logdir is not None or svg is not None:
        raise UsageError("--logdir and --svg are for one source", fix="name one")


def _propose_export(sources: Sequence[Path]) -> None:
    from export_model.converters.files.fetch import path_text
    from export_model.exporter.tables import command_text

    both = as_given({p.name for p in export_command.params if p.name is not None} - {"as_json"})
    say_next(command_text(*map(path_text, sources), *both, "-o", "exported"))


def _check_looked_at(given: Mapping[str, bool]) -> None:
    """Raise UsageError where a flag was given that reads a file in some way: Unity takes it as it is."""
    for flag in (flag for flag, value in given.items() if value):
        raise UsageError(f"{flag} is not for --unity", why="the file is looked at as it is", fix=f"leave {flag} out")


def _inspect_source(
    source: Path,
    compiling: CompileOptions,
    read: ReadOptions,
    logdir: Path | None,
    svg: Path | None,
    *,
    as_json: bool,
    why: bool,
) -> dict[str, Any]:
    """Say what is in a source, and which files of a folder could not be read; return it for a program.

    For a program (``as_json``) nothing is printed but errors.
    """
    from export_model.exporter.inspect.inspection import inspect_source, inspection_text

    refused: list[ExportModelError] = []
    found = inspect_source(source, compiling, read, refused, why=why)
    written: list[Path] = []
    if logdir is not None or svg is not None:
        from export_model.exporter.inspect.pictures import write_pictures

        written = write_pictures(found, logdir, svg)
    if not as_json:
        say_lines(inspection_text(found))
        for path in written:
            say(f"wrote {path}")
    for error in refused:
        say_lines(f"error: {error.message}", err=True)
    answer = {**found.to_dict(), **({"written": [str(path) for path in written]} if written else {})}
    return {**answer, **({"refused": [e.to_dict() for e in refused]} if refused else {})}


def _unity(
    source: Path,
    releases: tuple[str, ...],
    agent: tuple[str | None, str | None, Path | None],
    as_json: bool,
    svg: Path | None,
) -> tuple[int, dict[str, Any]]:
    from export_model.exporter.inspect.unity import all_accept, check_for_unity, unity_report, unity_text

    sensors, actions, parameters = agent
    verdicts = check_for_unity(source, releases, sensors or "", actions or "", parameters)
    if svg is not None:
        if len(verdicts) != 1:
            raise UsageError("--svg draws one verdict", fix="name one release and one file")
        from export_model.converters.formats.bundle.bundle import writing
        from export_model.exporter.inspect.behavior_parameters import behavior_parameters

        with writing(svg):
            svg.write_text(behavior_parameters(verdicts[0]), encoding="utf-8")
    if not as_json:
        say_lines(unity_text(verdicts))
    return 0 if all_accept(verdicts) else 1, unity_report(verdicts)
