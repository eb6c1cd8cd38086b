"""Unity's importers of ONNX that were measured, and spans of them by name."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.consumers.unity.consumers import CONSUMERS

#: The importers that were measured, the oldest first, and what of ML-Agents uses them.
IMPORTERS: Mapping[str, str] = {
    "Barracuda 1.1.2": "release 10",
    "Barracuda 1.4.0": "release 17",
    "Barracuda 2.0.0": "release 18",
    "Barracuda 2.3.1": "release 19",
    **{c.runtime: c.importer for c in CONSUMERS.values() if c.importer},
}


def span(since: str | None = None, until: str | None = None) -> tuple[str, ...]:
    """Return the importers from one to another, both included; None: from the oldest, to the newest there will be."""
    names = tuple(IMPORTERS)
    return names[names.index(since) if since else 0 : names.index(until) + 1 if until else None]


EVERY = span()
FIRST = span(until="Barracuda 1.1.2")
BARRACUDA = span(until="Barracuda 3.0.0")
LATER = span("Barracuda 1.4.0", "Barracuda 3.0.0")
BEFORE_2_3 = span(until="Barracuda 2.0.0")
FROM_1_4_TO_2_0 = span("Barracuda 1.4.0", "Barracuda 2.0.0")
FROM_1_4_TO_2_3 = span("Barracuda 1.4.0", "Barracuda 2.3.1")
FROM_2_3 = span("Barracuda 2.3.1", "Barracuda 3.0.0")
SENTIS = span("Sentis 2.1.3")
BEFORE_2_4 = span(until="Inference Engine 2.2.2")
FROM_2_4 = span("Inference Engine 2.4.0")
