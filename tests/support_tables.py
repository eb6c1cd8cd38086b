"""docs/support-tables.md: one page, each part of which a tool writes (`python -m tests.consumers`, and so on)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

from tests.commands import ROOT

PAGE = ROOT / "docs" / "support-tables.md"


def section(title: str) -> str:
    """Return the text of a part, its heading included, up to the next one."""
    return _parts()[title]


def write(title: str, text: str) -> None:
    """Put a part's new text, which begins with its heading, in the place of the old."""
    parts = _parts()
    assert text.startswith(f"## {title}\n") and title in parts, title
    PAGE.write_text("".join((parts | {title: text}).values()), encoding="utf-8")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table, and an empty one."""
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
    yield ""


def _parts() -> dict[str, str]:
    """The page by its headings of the second level; what is before the first is called ''."""
    found = re.split(r"^(?=## )", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {part.partition("\n")[0].removeprefix("## ") if part.startswith("## ") else "": part for part in found}
