"""The snippets' frames: a file each, under its own language's name, in the form of Python's string.Template."""

from __future__ import annotations

from pathlib import Path
from string import Template

_FOLDER = Path(__file__).resolve().parent / "templates"


def filled(template: str, /, **parts: str) -> str:
    """The frame called ``template`` with its parts put in; it ends with one line break."""
    text = Template((_FOLDER / f"{template}.tmpl").read_text(encoding="utf-8")).substitute(parts)
    return text.rstrip("\n") + "\n"
