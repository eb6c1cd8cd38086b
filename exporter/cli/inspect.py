"""The command ``inspect``. Imports click only; the rest when it runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from exporter.cli.options import shapes, understanding

if TYPE_CHECKING:
    from converters.graph.options import CompileOptions


@click.command("inspect")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.option("--step", type=int, metavar="N", help="The checkpoint of this step (default: the newest).")
@click.option("--logdir", type=click.Path(path_type=Path), metavar="DIR", help="Write its graph for TensorBoard.")
@click.option("--svg", type=click.Path(path_type=Path), metavar="FILE", help="Write a picture of the policy.")
@click.option("--sensors", default="", metavar="SHAPE,...", help="What the agent of a .pt observes: 8,3x84x84.")
@understanding
def inspect_command(
    source: Path,
    step: int | None,
    sensors: str,
    as_json: bool,
    logdir: Path | None,
    svg: Path | None,
    compiling: CompileOptions,
) -> None:
    """Show what is in a file: generation, brains, inputs and what to feed, outputs, ops, targets."""
    from converters.source import ReadOptions
    from exporter.inspect.inspection import inspect_source, inspection_text

    found = inspect_source(source, compiling, ReadOptions(step, shapes(sensors)))
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
