"""The consumers whose behaviour is known: releases of ML-Agents' C# package, each with the runtime it stands on.

Measured are exactly these pairs. Before release 20 it is the players that were run, on whole files and small models,
and their checkers on the same; what their importers misread stands in ``readings``. ML-Agents 3.0.0 and 4.0.0 have the
same checker; between Sentis 2.1.3 and Inference Engine 2.2.2 no verdict differs. ML-Agents 4.0.1 depends on Inference
Engine 2.4.1; the checker of 4.0.0 was run on 2.4.0 in its place.
"""

from __future__ import annotations

import re
from enum import Enum

from msgspec import Struct

from export_model.converters.formats.registry import BARRACUDA, ONNX
from export_model.signatures.errors import UsageError


class Engine(Enum):
    """The two families of runtimes; each reads a file its own way."""

    BARRACUDA = "Barracuda"
    SENTIS = "Sentis"


class Checks(Enum):
    """The generations of ML-Agents' checks: what they know of versions and of deterministic actions."""

    VERSION_2 = "1.9"
    VERSION_3 = "2.0"
    DETERMINISTIC = "2.3"


class Consumer(Struct, frozen=True):
    """A release and what tells it from the others.

    ``namespace`` stands in the text of a failed cast; ``strips_zero``: the importer takes ``:0`` from the end of
    names; ``reads_value_float``: it reads a Constant with ``value_float``; ``trips_on_reshape``: an output that is
    Identity of another output made by Reshape cannot be imported. ``profile`` is the ``--for`` that writes for it.

    ``checks`` are ML-Agents' checks that are known (None: not these); ``deterministic``: there is Deterministic
    Inference; ``reads_version``: the player goes by ``version_number``, and refuses what it does not know;
    ``feeds_entities``: there are sensors of two axes; ``fetches_action_alone``: no other output has actions.
    ``formats`` are those of which it is known what comes of them.
    ``refusals``: what its importer refuses is known (``importing``), not only what it misreads (``readings``).
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
    checks: Checks | None = Checks.DETERMINISTIC
    deterministic: bool = True
    reads_version: bool = True
    feeds_entities: bool = True
    fetches_action_alone: bool = False
    refusals: bool = True
    formats: tuple[str, ...] = (ONNX.key, BARRACUDA.key)
    #: ML-Agents' release by number, where the runtime's importer was measured; empty: it was not.
    importer: str = ""
    #: Whether its player was run, or its code read, or that of another release run in its place.
    played: str = "run"

    @property
    def title(self) -> str:
        """For people: release, package and runtime."""
        return f"{self.name} ({self.package} on {self.runtime})"


CONSUMERS = {
    consumer.name: consumer
    for consumer in (
        Consumer(
            "R20",
            "ML-Agents 2.3.0-exp.3",
            "Barracuda 3.0.0",
            Engine.BARRACUDA,
            "barracuda-3",
            importer="release 20",
        ),
        Consumer(
            "R22",
            "ML-Agents 3.0.0",
            "Sentis 2.1.3",
            Engine.SENTIS,
            "unity6",
            "Unity.Sentis",
            importer="release 22",
        ),
        Consumer(
            "R23",
            "ML-Agents 4.0.0",
            "Inference Engine 2.2.2",
            Engine.SENTIS,
            "unity6",
            "Unity.InferenceEngine",
            importer="release 23",
            played="the code of ML-Agents 3.0.0 run in its place",
        ),
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
            importer="release 23",
            played="that of R23; Inference Engine 2.4.0 was not played",
        ),
        # the next release comes here: importers, readings, players and profiles take it from its row
    )
}
#: Releases before those, whose players are known, and of whose checks less.
EARLIER = {
    consumer.name: consumer
    for consumer in (
        Consumer(
            "2.0.1",
            "ML-Agents 2.0.1",
            "Barracuda 2.0.0",
            Engine.BARRACUDA,
            "barracuda-1.4",
            checks=Checks.VERSION_3,
            deterministic=False,
            refusals=False,
        ),
        Consumer(
            "1.9.1",
            "ML-Agents 1.9.1",
            "Barracuda 1.3.2",
            Engine.BARRACUDA,
            "barracuda-1.0",
            checks=Checks.VERSION_2,
            deterministic=False,
            reads_version=False,
            refusals=False,
        ),
        Consumer(
            "1.0.8",
            "ML-Agents 1.0.8",
            "Barracuda 1.0.4",
            Engine.BARRACUDA,
            "barracuda-1.0",
            checks=None,
            deterministic=False,
            reads_version=False,
            feeds_entities=False,
            fetches_action_alone=True,
            refusals=False,
            formats=(BARRACUDA.key,),
        ),
    )
}


#: Profile → the editors whose projects its files are for, by the number that begins their version; 6000 is Unity 6.
EDITORS = {
    "unity6": ("2023", "6000"),
    "barracuda-3": ("2020", "2021", "2022"),
    "barracuda-1.4": ("2019", "2020", "2021"),
    "barracuda-1.0": ("2018", "2019", "2020"),
}


def purpose_text(releases: str, profile: str, engine: str) -> str:
    """Return what a profile is for: releases of ML-Agents, the editors, the runtime there."""
    first, *_, last = EDITORS[profile]
    editors = f"{first} and Unity 6" if last == "6000" else f"{first} to {last}"
    return f"{releases} in Unity {editors} ({engine})"


def editor_hint(version: str) -> str | None:
    """Return which releases an editor's version may stand for, and their profiles; None where it is not one."""
    found = re.fullmatch(r"(?:unity ?)?(20\d\d|6000|6(?=\.|$))(\..*)?", version.strip().lower())
    editor = "" if found is None else {"6": "6000"}.get(found[1], found[1])
    rows = [c for c in (*CONSUMERS.values(), *EARLIER.values()) if editor in EDITORS[c.profile]]
    if not rows:
        return None
    told = ", ".join(f"{c.package} on {c.runtime} (--unity {c.name}, --for {c.profile})" for c in rows)
    return f"it is a version of the editor; a project there may have {told}"


def releases_for(profile: str) -> tuple[Consumer, ...]:
    """Return the releases whose checks are known that a profile writes for, the oldest first."""
    return tuple(c for c in CONSUMERS.values() if c.profile == profile)


def consumer(name: str) -> Consumer:
    """A consumer by name, in any case of letters. Raises UsageError with the names there are."""
    every = {**CONSUMERS, **EARLIER}
    for known, found in every.items():
        if known.lower() == name.strip().lower():
            return found
    why = editor_hint(name)
    raise UsageError(
        f"--unity {name}: not a release whose rules are known",
        why=why,
        fix=f"one of {', '.join(c.title for c in every.values())}"
        if why is None
        else "choose by the versions in the project's Packages/manifest.json",
    )
