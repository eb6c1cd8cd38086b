"""The command ``snippets``. Imports click only; the rest when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import one_bundle
from export_model.exporter.cli.rows import PATH
from export_model.exporter.cli.terminal import say, say_json, say_lines, say_next
from export_model.signatures.errors import UsageError


@command(
    "snippets",
    "Print code that calls the policy.",
    ("export-model snippets exported/3DBall", "what there is"),
    ("export-model snippets exported/3DBall --for tfjs", "one, ready to be piped"),
)
@click.argument("bundle", type=PATH, metavar="BUNDLE", required=False)
@click.option("--for", "target", metavar="NAME", help="Print this one (or all that begin so); 'help' lists all.")
@click.option("--json", "as_json", is_flag=True, help="Print the code of all, or of --for, as JSON.")
def snippets_command(bundle: Path | None, target: str | None, as_json: bool) -> None:
    """Code to copy: how to call this policy from Python, TF Serving, JavaScript, C# and Unity."""
    from export_model.exporter.snippets.contract import read_bundle
    from export_model.exporter.snippets.registry import TARGETS, snippets
    from export_model.exporter.tables import command_text, table

    if target == "help":
        rows = [[t.name, t.title, t.formats_text] for t in TARGETS]
        if as_json:
            say_json({"targets": [dict(zip(("name", "title", "needs"), row, strict=True)) for row in rows]})
        else:
            say_lines(table(("--for", "what", "needs"), rows))
        return
    if bundle is None:
        raise UsageError("no bundle was given", fix="export-model snippets exported/3DBall")
    found = read_bundle(one_bundle(bundle, "snippets"))
    made, lacking = snippets(found, target)
    if as_json:
        say_json({"policy": found.name, "snippets": [s.to_dict() for s in made], "left_out": lacking})
        return
    if target is None:
        rows = [[s.target.name, s.target.title] for s in made]
        rows += [[t.name, f"{t.title}; needs {lacking[t.name]}"] for t in TARGETS if t.name in lacking]
        say_lines(table(("--for", "what"), rows))
        say_next(command_text("snippets", found.folder, "--for", made[0].target.name))
        return
    if len(made) == 1:
        say_lines(made[0].code, nl=False)
        return
    for snippet in made:
        say(f"==== {snippet.target.title} (--for {snippet.target.name}) ====")
        say()
        say_lines(snippet.code)
    for name, needed in lacking.items():
        say(f"left out: {name} needs {needed}, which this bundle lacks")
