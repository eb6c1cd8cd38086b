"""``python -m tests.consumers``: the tables of ``export-model consumers --json`` in docs/support-tables.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from export_model.converters.consumers.published import consumer_tables
from tests.support_tables import table, write

TITLE = "Unity's importers"
HEAD = f"""\
## {TITLE}

What these importers read otherwise than the operators are defined: 352 small models, one construct each, were run in
each importer outside the Editor, and 87 more in the players of ML-Agents ([what they do](tasks/unity-checker.md)). What
is not listed is read rightly, if it was among these. The program has the exceptions, fixes and models of evidence:

```sh
export-model consumers "Barracuda 2.0.0"        # what one importer misreads
export-model consumers --json > consumers.json  # everything
```

`--for` writes a policy without any of it; [`inspect --unity`](tasks/unity-checker.md) finds it in a file. *wrong*:
other numbers or another shape, without an error. *refused*: the import throws. *fails*: the run throws. *lost*: an
output cannot be fetched.
"""


def page() -> str:
    """Return the part of the page in Markdown."""
    tables = consumer_tables()
    return "\n".join((HEAD, *_importers(tables), *_readings(tables))) + "\n"


def _importers(tables: Mapping[str, Any]) -> Iterator[str]:
    profiles = tables["profiles"]
    yield from table(
        ("importer", "of ML-Agents release", "`--for`"),
        (
            (
                i["name"],
                i["release"].split()[-1],
                ", ".join(f"`{p['name']}`" for p in profiles if i["name"] in p["importers"]),
            )
            for i in tables["importers"]
        ),
    )


def _readings(tables: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each group of operators: each construct, what becomes of it, and in which versions."""
    yield "### Constructs\n"
    versions = [i["name"].split()[-1] for i in tables["importers"]]
    rules: dict[str, dict[tuple[str, str], list[Mapping[str, Any]]]] = {}
    for r in tables["readings"]:
        rules.setdefault(", ".join(r["ops"]), {}).setdefault((r["construct"], r["reading"]), []).append(r)
    cells: dict[str, dict[str, list[str]]] = {}
    for ops, of in sorted(rules.items()):
        for (what, how), rows in of.items():
            cells.setdefault(ops, {}).setdefault(f"*{how}* {_span(rows, versions)}", []).append(what)
    yield from table(
        ("operators", "how they are misread, in which versions, and what of them"),
        ((ops, ". ".join(f"{how}: {'; '.join(of)}" for how, of in cell.items())) for ops, cell in cells.items()),
    )


def _span(readings: Sequence[Mapping[str, Any]], versions: Sequence[str]) -> str:
    """The first and the last of an importer's versions (each importer has numbers of its own)."""
    first = min(versions.index(r["since"].split()[-1]) for r in readings)
    if any(not r["until"] for r in readings):
        return f"from {versions[first]}"
    last = max(versions.index(r["until"].split()[-1]) for r in readings)
    return versions[first] if first == last else f"{versions[first]}–{versions[last]}"


if __name__ == "__main__":
    write(TITLE, page())
