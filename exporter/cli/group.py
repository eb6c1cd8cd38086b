"""How the command line behaves as a whole: sources without a command's name, typos, --version.

Imports click only.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from export_model.exporter import __version__
from export_model.exporter.cli.rows import CANDIDATE, READING
from export_model.exporter.cli.terminal import say, say_lines
from export_model.signatures.errors import UsageError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

PROGRAM = "export-model"
_OWN = frozenset(("--help", "-h", "--help-all", "--version"))
#: Commands that ``--help`` leaves to ``--help-all``.
_RARE = frozenset(("card", "completion", "consumers", "layout", "skill"))


#: Title of a group of options → their parameters, in the order of the help.
GROUPS = {
    "What to write": (
        *("out", "targets", "profile", "name", "names", "noise", "deterministic", "labels", "opset", "logdir", "svg"),
        *(
            "dtype",
            "quantize",
            "batch",
            "bake",
            "play",
            "math",
            "weights",
            "outputs_of",
            "guard",
            "scene",
            "write",
            "target",
            "files",
        ),
    ),
    "How to read the source": ("source", "mapped", *(row.name for row in READING), "robot", "check"),
    "How to read the candidates": tuple(f"{CANDIDATE}{row.name}" for row in READING if not row.both),
    "What Unity would say": ("releases", "actions", "brain_parameters"),
    "How to play": ("env", "episodes", "most", "likeliest", "margin", "strict", "partner"),
    "How to verify": (
        *("runtimes", "allow_unverified", "samples", "seed", "steps", "atol", "rtol", "tolerances", "golden", "sizes"),
        *("required", "log"),
    ),
    "Many sources": ("jobs", "cluster", "again", "fail_fast"),
    "The server": ("host", "port", "opens", "no_open"),
    "Output": ("verbose", "quiet", "why", "as_json", "html", "markdown", "junit", "help", "help_all"),
}


#: Where a context keeps that all options are to be shown.
_ALL = "export_model.exporter.cli.help_all"


class Command(click.Command):
    """A command whose help has examples: (what is typed, what it does).

    Its options are those of ``core``, which are parameters, with ``--help``, and all of them in groups with
    ``--help-all``. Without ``core`` both are the same.
    """

    def __init__(
        self, *args: Any, examples: Sequence[tuple[str, str]] = (), core: Sequence[str] = (), **rest: Any
    ) -> None:
        super().__init__(*args, **rest)
        self.context_settings.setdefault("show_default", True)
        self.core = tuple(core)
        if core:
            self.params.append(help_all_option())
        self.examples = tuple(examples)
        width = max((len(typed) for typed, _ in examples), default=0)
        lines = [f"  {typed:{width}}  {what}".rstrip() for typed, what in examples]
        self.epilog = "\n".join(["\b", "Examples:", *lines]) if lines else None

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """The arguments; an option of another tool is answered by what to type here."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            from export_model.exporter.cli.guesses import answer_option

            answer_option(error)
            raise

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the core options, or all of them by group; an option that is in no group stands under Output."""
        if self.core and not ctx.meta.get(_ALL):
            with formatter.section("Options"):
                formatter.write_dl(self.core_options(ctx))
            return
        options = (p for p in self.get_params(ctx) if isinstance(p, click.Option))
        found = {p.name: r for p in options if (r := p.get_help_record(ctx)) is not None}
        grouped = {name: title for title, names in GROUPS.items() for name in names}
        for title in GROUPS:
            names = [n for n in found if grouped.get(n or "", "Output") == title]
            if names:
                with formatter.section(title):
                    formatter.write_dl([found[n] for n in sorted(names, key=_place)])

    def core_options(self, ctx: click.Context) -> list[tuple[str, str]]:
        """Return a line for each core option: its first name, and its help without the default."""
        ctx.show_default = False
        options = {p.name: p for p in self.get_params(ctx) if isinstance(p, click.Option)}
        records = (options[name].get_help_record(ctx) for name in (*self.core, "help_all"))
        return [(names.replace(", --runtimes", ""), text) for names, text in filter(None, records)]


def help_all_option() -> click.Option:
    """Return ``--help-all``."""
    return click.Option(
        ["--help-all"],
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=_show_all,
        help="Show all options and exit.",
    )


def _show_all(ctx: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        ctx.meta[_ALL] = True
        say_lines(ctx.get_help())
        ctx.exit()


def command(
    name: str, short_help: str, *examples: tuple[str, str], core: Sequence[str] = ()
) -> Callable[[Callable[..., Any]], Command]:
    """Turn a function into the command ``name``."""
    return click.command(name, cls=Command, short_help=short_help, examples=examples, core=core)


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

        from export_model.exporter.cli.guesses import answer_word

        answer_word(word)
        close = difflib.get_close_matches(word, self.commands, n=1, cutoff=0.7)
        if close and not Path(word).exists():
            raise UsageError(f"{word!r} is neither a command nor a file", fix=f"did you mean: {PROGRAM} {close[0]}?")

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Both ways to call the program."""
        formatter.write_usage(ctx.command_path, "SOURCE... [-o DIR] [OPTIONS]")
        formatter.write_usage(ctx.command_path, "COMMAND ...", prefix="       ")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of an export, which needs no command's name, and the commands."""
        export, everything = self.commands["export"], bool(ctx.meta.get(_ALL))
        assert isinstance(export, Command)
        own = click.Context(export, ctx, export.name, show_default=True)
        if everything:
            export.format_options(own, formatter)
            super().format_options(ctx, formatter)
            return
        with formatter.section("Options"):
            formatter.write_dl([*export.core_options(own)[:-1], ("--help-all", "Show all options and commands.")])
        with formatter.section("Commands"):
            shown = (name for name in self.list_commands(ctx) if name not in _RARE)
            formatter.write_dl([(name, self.commands[name].get_short_help_str()) for name in shown])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands, and files: the first word may be a source."""
        from click.shell_completion import CompletionItem

        return [*super().shell_complete(ctx, incomplete), CompletionItem(incomplete, type="file")]


def show_version(ctx: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    """``--version``: this program's, and the runtimes that were found."""
    if not wanted or ctx.resilient_parsing:
        return
    from export_model.converters.runtimes.registry import available_runtimes

    say(f"{PROGRAM}, version {__version__}")
    here = [f"{i.name} {i.version or ''}".strip() for i in available_runtimes() if i.installed]
    say(f"runtimes: {', '.join(here)}")
    ctx.exit()
