"""The command ``card``. Imports click only; the rest when it runs."""

from __future__ import annotations

from pathlib import Path

import click

from export_model.exporter.cli.group import command
from export_model.exporter.cli.options import one_bundle
from export_model.exporter.cli.rows import PATH
from export_model.exporter.cli.terminal import say


@command(
    "card",
    "Write README.md for a model hub.",
    ("export-model card exported/3DBall", "into the bundle"),
)
@click.argument("bundle", type=PATH, metavar="BUNDLE")
def card_command(bundle: Path) -> None:
    """Write the card of a bundle: what it sees and does, interface, returns, agreement, files, how to load it.

    The licence is left to whoever publishes it.
    """
    from export_model.converters.files.fetch import path_text
    from export_model.exporter.card.card import write_card

    say(f"wrote {path_text(write_card(one_bundle(bundle, 'card')))}")
