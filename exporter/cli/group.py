"""How the command line behaves as a whole: sources without a command's name, typos, --version.

Imports click only.
"""

from __future__ import annotations

import difflib
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from exporter.version import __version__
from signatures.errors import UsageError

PROGRAM = "export-model"
_OWN = frozenset(("--help", "-h", "--version"))


class SourceGroup(click.Group):
    """``export-model FILE`` is ``export-model export FILE``: anything that is not a command is a source."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """The arguments, with ``export`` before what is no command."""
        first = next((a for a in args if not a.startswith("-")), None)
        if args and (first is None or args[0] not in self.commands) and args[0] not in _OWN:
            if not ctx.resilient_parsing:
                self._refuse_typo(args[0])
            args = ["export", *args]
        return super().parse_args(ctx, args)

    def _refuse_typo(self, word: str) -> None:
        """A word that is nearly a command and no file is a command mistyped, not a source that is missing."""
        plain = word.replace("-", "").isalpha() and not word.startswith("-")
        close = difflib.get_close_matches(word, self.commands, n=1, cutoff=0.7) if plain else []
        if close and not Path(word).exists():
            raise UsageError(f"{word!r} is neither a command nor a file", fix=f"did you mean: {PROGRAM} {close[0]}?")

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Both ways to call the program."""
        formatter.write_usage(ctx.command_path, "SOURCE... [-o DIR] [OPTIONS]")
        formatter.write_usage(ctx.command_path, "COMMAND ...", prefix="       ")

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands, and files: the first word may be a source."""
        return [*super().shell_complete(ctx, incomplete), CompletionItem(incomplete, type="file")]


def show_version(ctx: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    """``--version``: this program's, and the runtimes that were found."""
    if not wanted or ctx.resilient_parsing:
        return
    from converters.runtimes.registry import available_runtimes

    click.echo(f"{PROGRAM}, version {__version__}")
    here = [f"{i.name} {i.version or ''}".strip() for i in available_runtimes() if i.installed]
    click.echo(f"runtimes: {', '.join(here)}")
    ctx.exit()
