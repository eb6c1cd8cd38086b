"""The commands, put together: each is in a module of its own, imported when it is asked for."""

from __future__ import annotations

import click

from exporter.cli.group import Rooms, SourceGroup, show_version

_COMMANDS = (
    "compare",
    "completion",
    "consumers",
    "demo",
    "export",
    "inspect",
    "runtimes",
    "serve",
    "snippets",
    "verify",
)


@click.group(
    cls=SourceGroup,
    commands=Rooms({name: f"exporter.cli.{name}" for name in _COMMANDS}),
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
    help="Show the version and the installed runtimes.",
)
def app() -> None:
    """The group; its commands do the work."""
