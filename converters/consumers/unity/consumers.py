"""The consumers whose behaviour is known: releases of ML-Agents' C# package, each with the runtime it stands on.

Measured are exactly these pairs. ML-Agents 3.0.0 and 4.0.0 have the same checker; between Sentis 2.1.3 and Inference
Engine 2.2.2 no verdict differs. ML-Agents 4.0.1 depends on Inference Engine 2.4.1; the checker of 4.0.0 was run on
2.4.0 in its place.
"""

from __future__ import annotations

from enum import Enum

from signatures.errors import UsageError
from signatures.records import dataclass


class Engine(Enum):
    """The two families of runtimes; each reads a file its own way."""

    BARRACUDA = "Barracuda"
    SENTIS = "Sentis"


@dataclass(frozen=True, slots=True)
class Consumer:
    """A release and what tells it from the others.

    ``namespace`` stands in the text of a failed cast; ``strips_zero``: the importer takes ``:0`` from the end of
    names; ``reads_value_float``: it reads a Constant with ``value_float``; ``trips_on_reshape``: an output that is
    Identity of another output made by Reshape cannot be imported. ``profile`` is the ``--for`` that writes for it.
    """

    name: str
    package: str
    runtime: str
    engine: Engine
    profile: str
    namespace: str = ""
    strips_zero: bool = True
    reads_value_float: bool = False
    trips_on_reshape: bool = False

    @property
    def title(self) -> str:
        """For people: release, package and runtime."""
        return f"{self.name} ({self.package} on {self.runtime})"


CONSUMERS = {
    consumer.name: consumer
    for consumer in (
        Consumer("R20", "ML-Agents 2.3.0-exp.3", "Barracuda 3.0.0", Engine.BARRACUDA, "barracuda-3"),
        Consumer("R22", "ML-Agents 3.0.0", "Sentis 2.1.3", Engine.SENTIS, "unity6", "Unity.Sentis"),
        Consumer("R23", "ML-Agents 4.0.0", "Inference Engine 2.2.2", Engine.SENTIS, "unity6", "Unity.InferenceEngine"),
        Consumer(
            "R23-2.4",
            "ML-Agents 4.0.0",
            "Inference Engine 2.4.0",
            Engine.SENTIS,
            "unity6",
            "Unity.InferenceEngine",
            strips_zero=False,
            reads_value_float=True,
            trips_on_reshape=True,
        ),
    )
}


def consumer(name: str) -> Consumer:
    """A consumer by name, in any case of letters. Raises UsageError with the names there are."""
    for known, found in CONSUMERS.items():
        if known.lower() == name.strip().lower():
            return found
    raise UsageError(f"--unity {name}: not a release whose rules are known", fix=f"one of {', '.join(CONSUMERS)}")
