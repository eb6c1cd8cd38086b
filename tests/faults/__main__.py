"""``python -m tests.faults``: faults of every class, planted into what export writes for policies of every family.

Without flags a sample of policies of fixtures/, as ``make test`` has it. ``--whole`` has every class once in every
policy of fixtures/ and ../shared (hours), each of ../shared written in one of many ways by ``--seed``; ``--policies 9``
takes nine of each family, ``--faults 5`` five classes for each policy, those that its family had least; ``--every``
has every tensor that can have it, ``--minutes 15`` what there is time for. ``--write`` keeps the table in
docs/figures.json, which docs/figures.md is made of.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from export_model.converters.runtimes.pool import RuntimePool
from export_model.signatures.errors import ExportModelError
from tests.faults.families import Member, members, shared
from tests.faults.judging import Fault, Outcome, Subject
from tests.faults.page import totals
from tests.figures import FIGURES, write

#: Faults of a member of the sample.
SAMPLED = 3


def sample(given: Iterable[Member]) -> list[Member]:
    """The first member of every family in every format, profile and way to write it."""
    found: dict[str, Member] = {}
    for member in given:
        how = sorted(str(v) for v in member.more.values())
        found.setdefault(f"{member.family} {member.form} {how}", member)
    return list(found.values())


def some(given: Iterable[Member], count: int, seed: int) -> list[Member]:
    """``count`` members of every family, by chance, the families in turn."""
    families: dict[str, list[Member]] = {}
    for member in given:
        families.setdefault(member.family, []).append(member)
    rng = random.Random(seed)
    chosen = [rng.sample(f, min(count, len(f))) for f in families.values()]
    return [m for turn in zip_longest(*chosen) for m in turn if m is not None]


class Turns:
    """Chooses the faults of one member after another: what was planted least, on another tensor each time."""

    def __init__(self) -> None:
        self._planted = Counter[str]()
        self._families = Counter[tuple[str, str]]()

    def choose(self, family: str, faults: Sequence[Fault], count: int | None) -> list[Fault]:
        """``count`` of them, a class each; of every class one for None."""
        kinds: dict[str, list[Fault]] = {}
        for fault in faults:
            kinds.setdefault(fault.kind, []).append(fault)
        order = sorted(kinds, key=lambda k: (self._families[family, k], self._planted[k]))
        chosen = []
        for kind in order[: len(order) if count is None else count]:
            chosen.append(kinds[kind][self._planted[kind] % len(kinds[kind])])
            self._planted[kind] += 1
            self._families[family, kind] += 1
        return chosen


def outcomes(
    given: Iterable[Member],
    pool: RuntimePool,
    *,
    count: int | None = None,
    every: bool = False,
    sound: bool = False,
    ways: Sequence[str] = (),
    turns: Turns | None = None,
) -> Iterator[Outcome]:
    """What comes of each fault, judged in one way in turn (``ways``: in these); if ``sound``, of none at first."""
    turns = turns or Turns()
    for number, member in enumerate(given):
        with tempfile.TemporaryDirectory() as folder:
            try:
                subject = Subject(member, Path(folder), pool)
            except ExportModelError:  # it is refused in this format, or for this consumer
                continue
            possible = [w for w in subject.ways() if not ways or w in ways]
            faults = list(subject.faults())
            right = {way: subject.judge(None, way) for way in possible} if sound else {}
            yield from right.values()
            possible = [w for w in possible if w not in right or right[w].verdict == "passed"]
            for place, fault in enumerate(faults if every else turns.choose(member.family, faults, count)):
                for way in possible if ways else possible[(number + place) % max(len(possible), 1) :][:1]:
                    yield subject.judge(fault, way)


def counted(found: Sequence[Outcome], command: str) -> dict[str, Any]:
    """The table of ``command``, as JSON: families → classes → [caught, located, planted], and what was missed."""
    cells: dict[str, dict[str, list[int]]] = {}
    for each in (o for o in found if o.verdict in ("caught", "missed") and o.kind != "no fault"):
        cell = cells.setdefault(each.family, {}).setdefault(each.kind, [0, 0, 0])
        cell[0] += each.verdict == "caught"
        cell[1] += each.located
        cell[2] += 1
    return {
        "command": command,
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "policies": len({o.member for o in found}),
        "cells": cells,
        "missed": [asdict(o) for o in found if o.verdict == "missed"],
        "without_effect": sum(o.verdict == "no effect" for o in found),
        "small": [f"{o.member}: {o.kind} at {o.tensor}" for o in found if o.verdict == "too small to be seen"],
        "alarms": [str(o) for o in found if o.kind == "no fault" and o.verdict != "passed"],
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--whole", action="store_true", help="every class in every policy of fixtures/ and ../shared")
    parser.add_argument("--every", action="store_true", help="every class at every tensor that can have it")
    parser.add_argument("--seed", type=int, default=0, help="chooses policies, and how each is written")
    parser.add_argument("--policies", type=int, help="so many of every family")
    parser.add_argument("--faults", type=int, help="so many classes of each policy")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop then")
    parser.add_argument("--only", default="", help="only policies whose family, name or format holds this")
    parser.add_argument("--ways", default="", help="export, verify, compare: each fault in all of these")
    parser.add_argument("--write", action="store_true", help="keep the table in docs/figures")
    options = parser.parse_args()
    given = (
        chain(members(), shared(options.seed)) if options.whole else members() if options.only else sample(members())
    )
    given = (m for m in given if options.only in f"{m.family} {m.label}")
    if options.policies is not None:
        given = some(given, options.policies, options.seed)
    found, end = [], time.monotonic() + 60 * options.minutes
    with RuntimePool() as pool:
        ways = [w for w in options.ways.split(",") if w]
        sound = options.whole or bool(options.only)
        count = options.faults or (None if sound else SAMPLED)
        for outcome in outcomes(given, pool, count=count, every=options.every, sound=sound, ways=ways):
            found.append(outcome)
            if outcome.verdict in ("missed", "no effect", "too small to be seen") or (
                outcome.kind,
                outcome.verdict,
            ) == ("no fault", "caught"):
                print(outcome, flush=True)
            if time.monotonic() > end:
                break
    words = [a for a in sys.argv[1:] if a != "--write"]
    content = counted(found, " ".join(["python -m tests.faults", *words]))
    if options.write:
        before = json.loads(FIGURES.read_text(encoding="utf-8"))
        kept = {**before, "faults": content}
        FIGURES.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
        write(kept)
    caught, located, planted = totals(content)
    print(
        f"{planted} faults in {content['policies']} policies: {caught} caught, {located} located, "
        f"{planted - caught} missed; {content['without_effect']} more change nothing, {len(content['small'])} too "
        f"little to be seen; {len(content['alarms'])} alarms without a fault"
    )
    return 1 if content["missed"] or content["alarms"] else 0


if __name__ == "__main__":
    sys.exit(main())
