"""``python -m tests.consumers``: docs/consumers.md, the tables of ``export-model consumers --json`` as a page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from converters.consumers.published import published
from tests.commands import ROOT

PAGE = ROOT / "docs" / "consumers.md"
HEAD = """\
# What Unity's importers misread

Barracuda, Sentis and the Inference Engine do not read every ONNX as the operators are defined. Here is what is known,
by importer and construct: 352 small models, one construct each, run in each importer outside the Editor, and 87 more
in the players of ML-Agents. What an importer is not named for it reads rightly, if the construct was among these. The
same tables as JSON, with the exceptions of each importer:

```sh
export-model consumers                          # the importers
export-model consumers "Barracuda 2.0.0"        # what one of them misreads
export-model consumers --json > consumers.json  # everything on this page
```

`--for` writes a policy without any of it; [`inspect --unity`](tasks/unity-checker.md) finds them in a file. *wrong*:
it imports and runs, and gives other numbers or another shape, without an error. *refused*: the import throws.
*fails*: the run throws. *lost*: an output cannot be fetched. The evidence is the name of the small model.
"""
PLAYED = """\
What ML-Agents' own code does with inputs and outputs of other forms than it expects, by release (`--unity`). Names in
braces stand for those of the model. What has no evidence was read in the code, not run.
"""


def page() -> str:
    """Return the page in Markdown."""
    tables = published()
    return "\n".join((HEAD, *_importers(tables), *_readings(tables["readings"]), *_players(tables["players"]))) + "\n"


def _importers(tables: Mapping[str, Any]) -> Iterator[str]:
    yield "## Importers\n"
    profiles = tables["profiles"]
    yield from _table(
        ("importer", "of", "`--for`"),
        (
            (i["name"], i["release"], ", ".join(f"`{p['name']}`" for p in profiles if i["name"] in p["importers"]))
            for i in tables["importers"]
        ),
    )


def _readings(readings: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """One line for a construct: the importers of a rule, and what the last of them throws."""
    yield "## Constructs\n"
    rules: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for r in readings:
        key = (", ".join(r["ops"]), r["construct"], r["reading"], r["evidence"])
        rules.setdefault(key, []).append(r)
    yield from _table(
        ("operators", "construct", "reading", "since", "until", "exception", "evidence"),
        (
            (ops, construct, reading, of[0]["since"], of[-1]["until"] or "", _code(of[-1]["exception"]), evidence)
            for (ops, construct, reading, evidence), of in sorted(rules.items(), key=lambda item: item[0][0])
        ),
    )


def _players(rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    yield f"## Players\n\n{PLAYED}"
    yield from _table(
        ("of", "form", "outcome", "releases", "exception", "fix", "evidence"),
        (
            (
                ", ".join(r["of"]),
                r["form"],
                r["outcome"],
                ", ".join(r["releases"]),
                _code(r["exception"]),
                r["fix"],
                ", ".join(r["evidence"]),
            )
            for r in rows
        ),
    )


def _code(text: str | None) -> str:
    return "" if text is None else f"`` {' '.join(text.split())} ``"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
    yield ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
