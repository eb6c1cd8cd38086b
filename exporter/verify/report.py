"""What a verification says of a policy, as data: the content of parity.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from typing import Any

from exporter.verify.findings import Failure, Finding, Shape, Undecided
from signatures.records import dataclass


def _badness(c: Finding) -> tuple[bool, bool, float]:
    return not c.passed, c.measured, c.max_abs_diff


@dataclass(frozen=True, slots=True)
class Pair:
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
            if not isinstance(c, Failure | Undecided):
                worst[c.output] = max(worst.get(c.output, c), c, key=_badness)
        return worst

    @property
    def worst_text(self) -> str:
        """The largest difference with its output, of what failed where anything did; else what there is to say."""
        told = [c for c in self.findings if not isinstance(c, Failure | Undecided)]
        worst = max(told, key=_badness, default=None)
        if worst is None:
            return "no answer"
        drawn = dict.fromkeys(c.output for c in told if isinstance(c, Shape) and c.output != worst.output)
        return f"{worst.cell()} {worst.output}" + (f"; drawn: {', '.join(drawn)}" if drawn else "")


@dataclass(frozen=True, slots=True)
class ParityReport:
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

    def __repr__(self) -> str:
        return f"<ParityReport {self.policy!r} {self.verdict}: {len(self.comparisons)} comparisons{self._worst}>"

    def _repr_html_(self) -> str:
        from exporter.reports.markup import notebook

        rows = [(p.format, p.runtime, "✓ ok" if p.passed else "✗ FAIL", p.worst_text) for p in self.pairs]
        return notebook(f"{self.policy}: {self.verdict}", (("format", "runtime", "verdict", "worst |Δ|"), rows))

    @property
    def _worst(self) -> str:
        """The largest difference and where, or how many disagree."""
        if self.failures:
            return f", {len(self.failures)} disagree"
        worst = max((c for c in self.comparisons if c.measured), key=lambda c: c.max_abs_diff, default=None)
        return "" if worst is None else f", worst |Δ| {worst.cell()} ({worst.output} of {worst.where})"

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
        return tuple(dict.fromkeys(c.output for c in self.comparisons if not isinstance(c, Failure | Undecided)))

    @property
    def verdict(self) -> str:
        """passed, self-consistent, failed or not verified."""
        if self.passed is None:
            return "not verified"
        if not self.passed:
            return "failed"
        return "self-consistent" if self.self_consistent else "passed"

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
            "seed": self.seed,
            "samples": self.samples,
            "reference": self.reference,
            "runtimes": {name: dict(entry) for name, entry in self.runtimes.items()},
            "comparisons": [c.to_dict() for c in self.comparisons],
            "sizes": dict(self.sizes),
            **({"whole_sizes": dict(self.whole_sizes)} if self.whole_sizes else {}),
            "notes": list(self.notes),
        }
