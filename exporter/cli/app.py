"""The commands, put together. Imports click only; everything else is imported by the command that needs it."""

from __future__ import annotations

import click

from exporter.cli.compare import compare_command
from exporter.cli.completion import completion_command
from exporter.cli.demo import demo_command
from exporter.cli.export import export_command
from exporter.cli.group import SourceGroup, show_version
from exporter.cli.inspect import inspect_command
from exporter.cli.runtimes import runtimes_command
from exporter.cli.serve import serve_command
from exporter.cli.snippets import snippets_command
from exporter.cli.verify import verify_command


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
    help="Show the version and the installed runtimes.",
)
def app() -> None:
    """The group; its commands do the work."""


for _command in (
    *(
        completion_command,
        demo_command,
        export_command,
        inspect_command,
        verify_command,
        compare_command,
        runtimes_command,
    ),
    *(serve_command, snippets_command),
):
    app.add_command(_command)
