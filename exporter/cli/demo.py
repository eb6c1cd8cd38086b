"""The command ``demo``: the other commands, on a policy that comes with the package. Imports click only."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import click

from export_model.exporter.cli.export import export_command
from export_model.exporter.cli.group import PROGRAM, command
from export_model.exporter.cli.rows import PATH
from export_model.exporter.cli.serve import serve_command
from export_model.exporter.cli.terminal import say, say_next


@command(
    "demo",
    "Try it: export a trained policy, compare it, see it act.",
    ("export-model demo", "everything, and the page in your browser"),
    ("export-model demo --no-open", "without the page"),
    ("export-model demo --files", "only files to try commands with"),
)
@click.option("-o", "--out", type=PATH, help="Folder for it all (default: demo; with --files, this one).")
@click.option("--no-open", is_flag=True, help="Do not open the page; exit once everything is written.")
@click.option("--files", is_flag=True, help="Write policies to try, and their environments for Gymnasium.")
def demo_command(out: Path | None, no_open: bool, files: bool) -> None:
    """Export a trained 3DBall, compare the formats, and open the page on which it acts.

    The policy comes with the package; the formats are compared in the installed runtimes.
    """
    if files:
        _write_files(out or Path())
        return
    _demonstrate(out or Path("demo"), no_open)


def _write_files(out: Path) -> None:
    from export_model.exporter.demo.files import FILES, write_files
    from export_model.exporter.tables import command_text

    write_files(out)
    width = max(map(len, FILES))
    for name, what in FILES.items():
        say(f"{out / name!s:{width + len(str(out / 'x')) - 1}}  {what}".rstrip())
    say_next(command_text(out / "3DBall.onnx", "-o", out / "exported"))


def _demonstrate(out: Path, no_open: bool) -> None:
    from export_model.converters.formats.bundle.bundle import writing
    from export_model.exporter.demo import BALL
    from export_model.signatures.errors import UsageError

    source, report = out / BALL.name, out / "parity.html"
    if out.exists() and any(p.is_symlink() or (p.exists() and not p.is_file()) for p in (source, report)):
        raise UsageError(
            f"{out} has something else in it", why="links are not written through", fix="-o names a folder"
        )
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(BALL, source)
    _run_as_typed(export_command, "", str(source), "-o", str(out), "--html", str(report))
    if no_open:
        return
    _run_as_typed(serve_command, "serve ", str(out / BALL.stem), "--port", "0", "--open")


def _run_as_typed(command: click.Command, name: str, *words: str) -> None:
    """Run a command, shown as a user would type it."""
    say(f" {PROGRAM} {name}{shlex.join(words)}", mark="$", colour="cyan")
    command.main(list(words), PROGRAM, standalone_mode=False)
