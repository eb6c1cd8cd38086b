"""The commands, put together, and ``completion``. Imports click only; a command imports what else it needs."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from exporter.cli.compare import compare_command
from exporter.cli.demo import demo_command
from exporter.cli.export import export_command
from exporter.cli.group import PROGRAM, SourceGroup, command, show_version
from exporter.cli.inspect import inspect_command
from exporter.cli.runtimes import runtimes_command
from exporter.cli.serve import serve_command
from exporter.cli.snippets import snippets_command
from exporter.cli.terminal import say, say_lines
from exporter.cli.verify import verify_command

_SHELLS = {
    "bash": 'add this to ~/.bashrc:  eval "$(export-model completion bash)"',
    "zsh": 'add this to ~/.zshrc:  eval "$(export-model completion zsh)"',
    "fish": "write it where fish looks:  export-model completion fish > ~/.config/fish/completions/export-model.fish",
}


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


@command(
    "completion",
    "Print the script for completion in a shell.",
    ("export-model completion bash", "its last line says how to use it"),
)
@click.argument("shell", type=click.Choice(tuple(_SHELLS)))
def completion_command(shell: str) -> None:
    """Print the script that completes commands, options and files; its last line says where it goes."""
    found = get_completion_class(shell)
    assert found is not None
    say_lines(found(click.Command(PROGRAM), {}, PROGRAM, "_EXPORT_MODEL_COMPLETE").source())
    say(f"# {_SHELLS[shell]}")


for _command in (
    *(completion_command, demo_command, export_command, inspect_command, verify_command),
    *(compare_command, runtimes_command, serve_command, snippets_command),
):
    app.add_command(_command)
