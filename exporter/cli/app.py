"""The commands, put together: each is in a module of its own, imported when it is asked for."""

from __future__ import annotations

import click

from export_model.exporter.cli.group import Rooms, SourceGroup, help_all_option, show_version

_COMMANDS = (
    "card",
    "compare",
    "completion",
    "consumers",
    "demo",
    "export",
    "inspect",
    "layout",
    "play",
    "runtimes",
    "serve",
    "skill",
    "snippets",
    "verify",
)


@click.group(
    cls=SourceGroup,
    commands=Rooms({name: f"export_model.exporter.cli.{name}" for name in _COMMANDS}),
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Export trained policies to every runtime, and prove that all files agree.",
    params=[help_all_option()],
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
