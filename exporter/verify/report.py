"""What a verification says of a policy, as data: the content of parity.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from msgspec import Struct, field
from msgspec.structs import asdict, replace

from export_model.exporter.tables import count_text
from export_model.exporter.verify.findings import Accepted, Failure, Finding, Played, Shape, Undecided
from export_model.exporter.verify.plays import PlayRecord
from export_model.exporter.verify.verdict import unchecked_formats, verdict


def _badness(c: Finding) -> tuple[bool, bool, float]:
    return not c.passed, c.measured, c.share if c.measured else c.max_abs_diff


class Pair(Struct, frozen=True):
    """All findings on one format (of a SavedModel: one signature) in one runtime."""

    format: str
    runtime: str
    findings: tuple[Finding, ...]

    @property
    def passed(self) -> bool:
        """Whether all of it agrees."""
        return all(c.passed for c in self.findings)

    @property
    def worst(self) -> dict[str, Finding]:
        """Output → the worst that was found of it; an output that has no answer is not in it."""
        worst: dict[str, Finding] = {}
        for c in self.findings:
            if not isinstance(c, Accepted | Failure | Undecided):
                worst[c.output] = max(worst.get(c.output, c), c, key=_badness)
        return worst

    @property
    def word(self) -> str:
        """What became of it, in a word: a checker accepts, and does not agree."""
        if any(c.disagrees for c in self.findings):
            return "FAIL"
        if not self.passed:
            return "not run"
        return "accepted" if all(isinstance(c, Accepted) for c in self.findings) else "ok"

    @property
    def worst_text(self) -> str:
        """The largest share of what is allowed with its output, of what failed where anything did; else a word."""
        if all(isinstance(c, Accepted) for c in self.findings):
            checked = [c for c in self.findings if not isinstance(c, Played)]
            played = [c for c in self.findings if isinstance(c, Played)]
            words = [f"{'' if all(c.passed for c in checked) else 'not '}checked"] if checked else []
            words += [f"{'' if all(c.passed for c in played) else 'not '}played by our model of it"] if played else []
            return ", ".join(words)
        if all(isinstance(c, Undecided) for c in self.findings):
            return "not decided"
        told = [c for c in self.findings if not isinstance(c, Accepted | Failure | Undecided)]
        worst = max(told, key=_badness, default=None)
        if worst is None:
            return "no answer"
        drawn = dict.fromkeys(c.output for c in told if isinstance(c, Shape) and c.output != worst.output)
        return f"{worst.cell()} {worst.output}" + (f"; drawn: {', '.join(drawn)}" if drawn else "")


class SideCause(Struct, frozen=True):
    """What makes one ``side`` of a comparison the other: a cause of the table of ``verify --log``.

    ``format`` is what the report calls the candidate, ``kind`` the row, ``where`` the tensor or column.
    """

    format: str
    side: str
    kind: str
    where: str
    says: str

    def to_dict(self) -> dict[str, str]:
        """Return its entry in ``causes`` of parity.json."""
        return asdict(self)


class ParityReport(Struct, frozen=True):
    """All findings on one policy. ``passed`` is None where no independent runtime ran."""

    policy: str
    passed: bool | None
    seed: int
    samples: int
    reference: str
    runtimes: Mapping[str, Mapping[str, str | None]]
    comparisons: tuple[Finding, ...]
    sizes: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    #: what the formats would take with weights in float32, where these are kept in less
    whole_sizes: Mapping[str, int] = field(default_factory=dict)
    #: No runtime reads the source by itself (a .nn): the formats were compared with this project's own reading of it.
    self_consistent: bool = False
    #: The runtime that the original ran in; None where it did not run.
    original: str | None = None
    #: what the bundle's files earned when they played
    played: tuple[PlayRecord, ...] = ()
    #: what of a comparison makes one side the other, in the order in which it is applied
    causes: tuple[SideCause, ...] = ()

    def __repr__(self) -> str:
        compared = count_text(len(self.comparisons), "comparison")
        return f"<ParityReport {self.policy!r} {self.verdict}: {compared}{self._worst}>"

    def _repr_html_(self) -> str:
        from export_model.exporter.markup import notebook

        rows = [(p.format, p.runtime, f"{'✓' if p.passed else '✗'} {p.word}", p.worst_text) for p in self.pairs]
        return notebook(f"{self.policy}: {self.sentence}", (("format", "runtime", "verdict", "of tolerance"), rows))

    @property
    def _worst(self) -> str:
        """The largest difference and where, or how many disagree."""
        if self.failures:
            return f", {len(self.failures)} disagree"
        worst = max((c for c in self.comparisons if c.measured), key=lambda c: c.share, default=None)
        return "" if worst is None else f", at most {worst.cell()} of the tolerance ({worst.output} of {worst.where})"

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """What was found of each format in each runtime, in the order of the comparisons."""
        groups: dict[tuple[str, str], list[Finding]] = {}
        for c in self.comparisons:
            groups.setdefault((c.format, c.runtime), []).append(c)
        return tuple(Pair(kind, runtime, tuple(found)) for (kind, runtime), found in groups.items())

    @property
    def outputs(self) -> tuple[str, ...]:
        """The outputs that any runtime answered for."""
        silent = Accepted | Failure | Undecided
        return tuple(dict.fromkeys(c.output for c in self.comparisons if not isinstance(c, silent)))

    @property
    def verdict(self) -> str:
        """passed, self-consistent, failed or not verified."""
        if self.passed is None:
            return "not verified"
        if not self.passed:
            return "failed"
        return "self-consistent" if self.self_consistent else "passed"

    @property
    def sentence(self) -> str:
        """The verdict as every report words it."""
        return verdict(self)

    @property
    def partial(self) -> bool:
        """Whether it passed and some formats were not checked by an independent runtime."""
        return self.passed is True and bool(self.unchecked)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """The formats that no independent runtime ran."""
        return tuple(unchecked_formats(self))

    @property
    def proven(self) -> bool:
        """Whether what was compared agrees with the original itself, which ran: only this is shown in green."""
        return self.passed is True and self.original is not None

    @property
    def undecided(self) -> str:
        """Why nothing was decided although runtimes ran; empty where something was, or none ran."""
        why = [c.reason for c in self.comparisons if isinstance(c, Undecided)]
        return why[0] if why and self.passed is None else ""

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The comparisons that did not pass."""
        return tuple(c for c in self.comparisons if not c.passed)

    def with_findings(self, found: Iterable[Finding]) -> ParityReport:
        """The report with further findings."""
        comparisons = (*self.comparisons, *found)
        passed = False if any(c.disagrees for c in comparisons) else self.passed
        return replace(self, comparisons=comparisons, passed=passed)

    def to_dict(self) -> dict[str, Any]:
        """The content of parity.json."""
        return {
            "schema": 1,
            "policy": self.policy,
            "passed": self.passed,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "partial": self.partial,
            "unchecked": list(self.unchecked),
            "original": self.original,
            "seed": self.seed,
            "samples": self.samples,
            "reference": self.reference,
            "runtimes": {name: dict(entry) for name, entry in self.runtimes.items()},
            "comparisons": [c.to_dict() for c in self.comparisons],
            "sizes": dict(self.sizes),
            **({"whole_sizes": dict(self.whole_sizes)} if self.whole_sizes else {}),
            "notes": list(self.notes),
            **({"played": [record.to_dict() for record in self.played]} if self.played else {}),
            **({"causes": [cause.to_dict() for cause in self.causes]} if self.causes else {}),
        }
