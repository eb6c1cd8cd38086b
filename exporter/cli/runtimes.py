"""The command ``runtimes``. Imports click only; the rest when it runs."""

from __future__ import annotations

import click

from export_model.exporter.cli.terminal import say, say_json, say_lines, say_paragraph
from export_model.signatures.errors import UsageError

#: Part of the confinement of a runtime's process → what it means.
_SAID = {
    "reading": "reads the system's programs, the interpreter and what it is handed only",
    "writing": "writes to a scratch folder only",
    "network": "has no network",
    "memory": "has bounded memory",
    "processor": "has bounded time",
}


@click.group(
    "runtimes",
    invoke_without_command=True,
    subcommand_metavar="[install NAME]",
    short_help="List the runtimes, and how to install the others.",
    epilog="\b\nExamples:\n  export-model runtimes               what is here\n"
    "  export-model runtimes install tfjs  TensorFlow.js in Node and in a browser",
)
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def runtimes_command(ctx: click.Context, as_json: bool) -> None:
    """List the installed runtimes with their versions, and how to install the others."""
    if ctx.invoked_subcommand is not None:
        return
    from export_model.converters.files.children.confinement import in_force
    from export_model.converters.runtimes.registry import available_runtimes
    from export_model.exporter.tables import table

    found = available_runtimes()
    kept = in_force()
    if as_json:
        rows = [{"name": i.name, "installed": i.installed, "version": i.version, "install": i.how} for i in found]
        say_json({"runtimes": rows, "confinement": kept})
        return
    cells = [[i.name, i.version or "-", "installed" if i.installed else i.how] for i in found]
    say_lines(table(("runtime", "version", "state"), cells))
    lacking = [_SAID[part] for part, there in kept.items() if not there]
    held = [_SAID[part] for part, there in kept.items() if there]
    say()
    if held:
        sandbox = " (a browser has its own sandbox)" if not lacking else ""
        say_paragraph(f"{', '.join(held)}{sandbox}", "a runtime's process ")
    if lacking:
        say_paragraph(", ".join(lacking), "not on this system: ")


@runtimes_command.command("install", short_help="Install tfjs, onnxruntime-web, litert-web or tf1.")
@click.argument("name")
def install_command(name: str) -> None:
    """Install tfjs, onnxruntime-web, litert-web or tf1 into the user's cache folder; pip installs the others."""
    from export_model.converters.runtimes.registry import RUNTIMES

    chosen = [r for r in RUNTIMES if r.name == name]
    chosen = chosen or [r for r in RUNTIMES if r.name.startswith((f"{name}-", f"{name}."))]
    steps = list(dict.fromkeys(r.install for r in chosen if r.install is not None))
    if steps:
        for install in steps:
            install(say)
        return
    how = {r.name: r.find().how for r in chosen}.get(name)
    raise UsageError(
        f"runtimes install {name}: " + ("unknown runtime" if how is None else "this command does not install it"),
        fix=how or "export-model runtimes lists the runtimes and how to install each",
    )
