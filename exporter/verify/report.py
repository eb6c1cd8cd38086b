"""What a verification says of a policy, as data: the content of parity.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from exporter.verify.findings import Finding


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
    #: No runtime reads the source by itself (a .nn): the formats were compared with this project's own reading of it.
    self_consistent: bool = False

    @property
    def verdict(self) -> str:
        """passed, self-consistent, failed or not verified."""
        if self.passed is None:
            return "not verified"
        if not self.passed:
            return "failed"
        return "self-consistent" if self.self_consistent else "passed"

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The comparisons that did not pass."""
        return tuple(c for c in self.comparisons if not c.passed)

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
            "notes": list(self.notes),
        }
