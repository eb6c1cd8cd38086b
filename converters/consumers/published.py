"""All that is known of Unity's consumers as records of JSON: what ``export-model consumers --json`` prints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from export_model.converters.consumers.profiles import PROFILES
from export_model.converters.consumers.unity.consumers import CONSUMERS, EARLIER
from export_model.converters.consumers.unity.exceptions import exception_of
from export_model.converters.consumers.unity.importers import IMPORTERS
from export_model.converters.consumers.unity.players import PLAYERS, Row
from export_model.converters.consumers.unity.readings import RULES, Form, Reading

_THROWN = (Reading.REFUSED, Reading.FAILS)


def consumer_tables() -> dict[str, Any]:
    """Return the tables: importers, releases, profiles, readings (importer × construct) and what players do."""
    return {
        "schema": 1,
        "importers": [{"name": name, "release": f"ML-Agents {release}"} for name, release in IMPORTERS.items()],
        "releases": [
            {
                "name": c.name,
                "package": c.package,
                "runtime": c.runtime,
                "profile": c.profile,
                "formats": list(c.formats),
                "played": PLAYERS[c.name].played,
            }
            for c in (*CONSUMERS.values(), *EARLIER.values())
        ],
        "profiles": [
            {
                "name": p.name,
                "purpose": p.purpose,
                "formats": list(p.formats),
                "opset": p.opset if p.importers else None,
                "importers": list(p.importers),
                "releases": list(dict.fromkeys((*p.checkers, *p.players))),
            }
            for p in PROFILES
        ],
        "readings": [reading for rule in RULES for reading in _readings(rule)],
        "players": list(_player_records()),
    }


def _readings(rule: Form) -> Iterator[dict[str, Any]]:
    """A record for each importer that a rule concerns."""
    newest = tuple(IMPORTERS)[-1]
    for importer in rule.importers:
        profiles = [p.name for p in PROFILES if importer in p.importers]
        yield {
            "importer": importer,
            "ops": list(rule.ops),
            "construct": rule.says,
            "reading": rule.reading.value,
            "exception": exception_of(rule.evidence, importer) if rule.reading in _THROWN else None,
            "evidence": rule.evidence,
            "since": rule.importers[0],
            "until": None if rule.importers[-1] == newest else rule.importers[-1],
            "fix": " or ".join(f"--for {p}" for p in profiles),
        }


def _player_records() -> Iterator[dict[str, Any]]:
    """A record for each form of an input or output, with the releases in which it comes to the same."""
    rows: dict[int, tuple[Row, str, list[str]]] = {}
    for player in PLAYERS.values():
        for kind, some in (("input", player.inputs), ("output", player.outputs)):
            for row in some:
                rows.setdefault(id(row), (row, kind, []))[2].append(player.name)
    for row, kind, releases in rows.values():
        yield {
            "releases": releases,
            "kind": kind,
            "of": list(row.of),
            "form": row.form,
            "outcome": row.outcome.value,
            "says": row.says,
            "exception": row.exception or None,
            "evidence": [part.strip() for part in row.evidence.replace(";", ",").split(",") if part.strip()],
            "fix": row.fix,
        }
