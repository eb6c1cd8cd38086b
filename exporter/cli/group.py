"""How the command line behaves as a whole: sources without a command's name, typos, --version.

Imports click only.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from exporter import __version__
from exporter.cli.terminal import say
from signatures.errors import UsageError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

PROGRAM = "export-model"
#: What options and arguments take that are paths: of any kind, of a file.
PATH, FILE = click.Path(path_type=Path), click.Path(path_type=Path, dir_okay=False)
_OWN = frozenset(("--help", "-h", "--version"))


#: Title of a group of options → their parameters, in the order of the help.
GROUPS = {
    "What to write": (
        *("out", "targets", "profile", "name", "names", "noise", "deterministic", "labels", "opset", "logdir", "svg"),
        *("dtype", "quantize", "batch", "scene", "target"),
    ),
    "How to read the source": (
        *("source", "step", "brain", "inputs", "outputs", "values", "mapped", "sensors", "activation", "trust_source"),
    ),
    "What Unity would say": ("releases", "actions", "brain_parameters"),
    "How to verify": (
        *("runtimes", "allow_unverified", "samples", "seed", "steps", "atol", "rtol", "tolerances", "golden", "sizes"),
        "required",
    ),
    "Many sources": ("jobs", "cluster", "again", "fail_fast"),
    "The server": ("host", "port", "opens", "no_open"),
    "Output": ("verbose", "quiet", "why", "as_json", "html", "markdown", "junit", "help"),
}


class Command(click.Command):
    """A command whose help has its options in groups, and examples: (what is typed, what it does)."""

    def __init__(self, *args: Any, examples: Sequence[tuple[str, str]] = (), **rest: Any) -> None:
        super().__init__(*args, **rest)
        self.context_settings.setdefault("show_default", True)
        self.examples = tuple(examples)
        width = max((len(typed) for typed, _ in examples), default=0)
        lines = [f"  {typed:{width}}  {what}" for typed, what in examples]
        self.epilog = "\n".join(["\b", "Examples:", *lines]) if lines else None

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The options by group; an option that is in none stands under Output."""
        options = (p for p in self.get_params(ctx) if isinstance(p, click.Option))
        found = {p.name: r for p in options if (r := p.get_help_record(ctx)) is not None}
        grouped = {name: title for title, names in GROUPS.items() for name in names}
        for title in GROUPS:
            names = [n for n in found if grouped.get(n or "", "Output") == title]
            if names:
                with formatter.section(title):
                    formatter.write_dl([found[n] for n in sorted(names, key=_place)])


def command(name: str, short_help: str, *examples: tuple[str, str]) -> Callable[[Callable[..., Any]], Command]:
    """A function as the command ``name``."""
    return click.command(name, cls=Command, short_help=short_help, examples=examples)


def _place(name: str | None) -> int:
    order = [n for names in GROUPS.values() for n in names]
    return order.index(name) if name in order else len(order)


class Rooms(MutableMapping[str, click.Command]):
    """A command's name → the command, ``NAME_command`` in its module, which is imported when it is asked for."""

    def __init__(self, modules: Mapping[str, str]) -> None:
        self._rooms: dict[str, str | click.Command] = dict(modules)

    def __getitem__(self, name: str) -> click.Command:
        room = self._rooms[name]
        if isinstance(room, str):
            self._rooms[name] = room = getattr(importlib.import_module(room), f"{name}_command")
        return room

    def __contains__(self, name: object) -> bool:
        return name in self._rooms

    def __iter__(self) -> Iterator[str]:
        return iter(self._rooms)

    def __len__(self) -> int:
        return len(self._rooms)

    def __setitem__(self, name: str, made: click.Command) -> None:
        self._rooms[name] = made

    def __delitem__(self, name: str) -> None:
        del self._rooms[name]


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
        if word.startswith("-") or not word.replace("-", "").isalpha():
            return
        import difflib

        close = difflib.get_close_matches(word, self.commands, n=1, cutoff=0.7)
        if close and not Path(word).exists():
            raise UsageError(f"{word!r} is neither a command nor a file", fix=f"did you mean: {PROGRAM} {close[0]}?")

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Both ways to call the program."""
        formatter.write_usage(ctx.command_path, "SOURCE... [-o DIR] [OPTIONS]")
        formatter.write_usage(ctx.command_path, "COMMAND ...", prefix="       ")

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands, and files: the first word may be a source."""
        from click.shell_completion import CompletionItem

        return [*super().shell_complete(ctx, incomplete), CompletionItem(incomplete, type="file")]


def show_version(ctx: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    """``--version``: this program's, and the runtimes that were found."""
    if not wanted or ctx.resilient_parsing:
        return
    from converters.runtimes.registry import available_runtimes

    say(f"{PROGRAM}, version {__version__}")
    here = [f"{i.name} {i.version or ''}".strip() for i in available_runtimes() if i.installed]
    say(f"runtimes: {', '.join(here)}")
    ctx.exit()
