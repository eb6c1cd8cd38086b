"""The command ``consumers``. Imports click only; the rest when it runs."""

from __future__ import annotations

import click

from export_model.exporter.cli.terminal import say, say_json, say_lines, say_next
from export_model.signatures.errors import UsageError


@click.command("consumers", short_help="List Unity's importers and what each of them misreads.")
@click.argument("importer", required=False)
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def consumers_command(importer: str | None, as_json: bool) -> None:
    """List Unity's importers of ONNX, or what one of them (``"Barracuda 2.0.0"``) misreads, refuses or fails at.

    With --json all tables: importers, releases of ML-Agents, profiles, readings by importer and construct with the
    exception and the evidence, and what the players make of inputs and outputs.
    """
    from export_model.converters.consumers.published import consumer_tables
    from export_model.exporter.tables import table

    tables = consumer_tables()
    names = [i["name"] for i in tables["importers"]]
    if importer is not None and importer not in names:
        raise UsageError(
            f"consumers {importer!r}: the importer must be one that was measured", fix=f"one of {', '.join(names)}"
        )
    if as_json:
        if importer is not None:
            tables = {**tables, "readings": [r for r in tables["readings"] if r["importer"] == importer]}
        say_json(tables)
        return
    if importer is None:
        counts = {name: sum(r["importer"] == name for r in tables["readings"]) for name in names}
        profiles = {n: ", ".join(p["name"] for p in tables["profiles"] if n in p["importers"]) for n in names}
        rows = [[i["name"], i["release"], profiles[i["name"]], str(counts[i["name"]])] for i in tables["importers"]]
        say_lines(table(("importer", "of", "--for", "misreadings"), rows))
        say()
        say_next("export-model consumers 'Barracuda 2.0.0', or --json for everything")
        return
    mine = [r for r in tables["readings"] if r["importer"] == importer]
    cells = [[", ".join(r["ops"]), r["reading"], r["construct"], r["evidence"]] for r in mine]
    say_lines(table(("operators", "reading", "construct", "evidence"), cells))
