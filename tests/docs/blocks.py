"""Fenced blocks of a Markdown page, with what the page says about testing them.

A comment on the line before a block: ``<!-- test: VERB ARGUMENTS -->``. The verbs are

- ``skip REASON``: it is not run;
- ``check REASON``: only its syntax is looked at;
- ``status N``: the commands end with this status;
- ``until TEXT``: the command is one that stays; it is interrupted when it has printed this;
- ``continues``: a program that goes on where the page's last one ended;
- ``file PATH``, ``insert PATH after LINE``, ``in the copy``: see test_extending.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.commands import ROOT

VERBS = ("skip", "check", "status", "until", "continues", "file", "insert", "in the copy")
_ANNOTATION = re.compile(r"<!-- test: (.*) -->")
_FENCE = re.compile(r"( *)(`{3,})(.*)")


@dataclass(frozen=True)
class Block:
    """The text between two fences; ``line`` is that of the opening one, counted from 1."""

    page: str
    line: int
    language: str
    text: str
    verb: str = ""
    argument: str = ""

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"


def pages() -> list[Path]:
    """README.md and everything of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in order."""
    return list(blocks_of(page.read_text(encoding="utf-8"), name_of(page)))


def blocks_of(text: str, page: str) -> Iterator[Block]:
    lines = text.splitlines()
    at = 0
    while at < len(lines):
        opened = _FENCE.fullmatch(lines[at])
        if opened is None:
            at += 1
            continue
        indent, fence, language = opened.groups()
        end = next((i for i in range(at + 1, len(lines)) if lines[i].strip() == fence), None)
        assert end is not None, f"{page}:{at + 1}: the block is not closed"
        said = _ANNOTATION.fullmatch(lines[at - 1].strip()) if at else None
        verb, argument = _split(said[1], f"{page}:{at}") if said else ("", "")
        inside = "".join(f"{line.removeprefix(indent)}\n" for line in lines[at + 1 : end])
        yield Block(page, at + 1, language.strip(), inside, verb, argument)
        at = end + 1


def _split(said: str, where: str) -> tuple[str, str]:
    verb = next((v for v in VERBS if said == v or said.startswith(f"{v} ")), None)
    assert verb is not None, f"{where}: there is no such annotation: {said}"
    return verb, said.removeprefix(verb).strip()
