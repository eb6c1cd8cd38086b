"""The command ``completion``. Imports click only."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from export_model.exporter.cli.group import PROGRAM, command
from export_model.exporter.cli.terminal import say, say_lines

_SHELLS = {
    "bash": 'add this to ~/.bashrc:  eval "$(export-model completion bash)"',
    "zsh": 'add this to ~/.zshrc:  eval "$(export-model completion zsh)"',
    "fish": "write it where fish looks:  export-model completion fish > ~/.config/fish/completions/export-model.fish",
}


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
