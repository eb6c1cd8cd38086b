"""``python -m tests.consumers``: docs/consumers.md, the tables of ``export-model consumers --json`` as a page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from export_model.converters.consumers.published import consumer_tables
from tests.commands import ROOT

PAGE = ROOT / "docs" / "consumers.md"
HEAD = """\
# What Unity's importers misread

Barracuda, Sentis and the Inference Engine do not read every ONNX as the operators are defined. Here is what is known,
by importer and construct: 352 small models, one construct each, run in each importer outside the Editor, and 87 more
in the players of ML-Agents ([what they do](tasks/unity-checker.md)). What an importer is not named for it reads
rightly, if the construct was among these. The
program has more of it: for each importer what it throws, how to fix it, and the small model that shows it.

```sh
export-model consumers                          # the importers
export-model consumers "Barracuda 2.0.0"        # what one of them misreads
export-model consumers --json > consumers.json  # everything, with exceptions, fixes and evidence
```

`--for` writes a policy without any of it; [`inspect --unity`](tasks/unity-checker.md) finds them in a file. *wrong*:
it imports and runs, and gives other numbers or another shape, without an error. *refused*: the import throws.
*fails*: the run throws. *lost*: an output cannot be fetched.
"""


def page() -> str:
    """Return the page in Markdown."""
    tables = consumer_tables()
    return "\n".join((HEAD, *_importers(tables), *_readings(tables["readings"]))) + "\n"


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
    """Yield a line for each construct and reading."""
    yield "## Constructs\n"
    rules: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for r in readings:
        rules.setdefault((", ".join(r["ops"]), r["construct"], r["reading"]), []).append(r)
    yield from _table(
        ("operators", "construct", "reading", "since", "until"),
        (
            (*key, of[0]["since"], of[-1]["until"] or "")
            for key, of in sorted(rules.items(), key=lambda item: item[0][0])
        ),
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
    yield ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
