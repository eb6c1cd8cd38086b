"""What verification found, as data: the content of parity.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from exporter.verify.histogram import to_dict
from exporter.verify.tolerances import Tolerance


@dataclass(frozen=True, slots=True)
class Bisection:
    """Where a disagreement begins: the first tensor in graph order that differs in that runtime.

    ``source`` is the tensor of the source that it stands for. ``index`` is where the worst element is, ``expected`` and
    ``got`` its values. ``hidden`` are tensors right before it that the format does not have, because they were fused
    into its op: they may be the first as well. Where nothing could be named, ``tensor`` is None; ``reason`` says why.
    """

    tensor: str | None
    op: str | None = None
    source: str | tuple[str, ...] | None = None
    index: tuple[int, ...] | None = None
    expected: float | None = None
    got: float | None = None
    max_abs_diff: float | None = None
    smallest_tolerance: float | None = None
    hidden: tuple[str, ...] = ()
    #: What was fed where that is not the comparison's worst input: the first step that differs.
    input: str | None = None
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """As in parity.json."""
        if self.tensor is None:
            return {"tensor": None, "reason": self.reason}
        numbers = {k: getattr(self, k) for k in ("expected", "got", "max_abs_diff", "smallest_tolerance")}
        entry: dict[str, Any] = {
            "tensor": self.tensor,
            "op": self.op,
            "source": list(self.source) if isinstance(self.source, tuple) else self.source,
            "index": None if self.index is None else list(self.index),
            **{k: None if v is None else _number(v) for k, v in numbers.items()},
        }
        if self.hidden:
            entry["hidden"] = list(self.hidden)
        if self.input is not None:
            entry["input"] = self.input
        if self.reason:
            entry["reason"] = self.reason
        return entry


@dataclass(frozen=True, slots=True)
class Comparison:
    """One output of one format in one runtime against the reference, over all inputs.

    ``kind`` is ``numbers``, ``draws`` (goodness of fit; ``max_abs_diff`` is then the p-value's complement), ``rollout``
    (the memory fed back; ``drift`` has the worst difference of each step) or ``failure`` (the runtime gave no answer).
    ``rounding`` is not zero where the worst difference is above the tolerance, but within what float32 explains.
    """

    format: str
    runtime: str
    output: str
    kind: str
    max_abs_diff: float
    max_rel_diff: float
    tolerance: Tolerance
    passed: bool
    worst_input: str | None
    reason: str = ""
    drift: tuple[float, ...] = ()
    rounding: float = 0.0
    #: Elements of all inputs per decade of ``|a − b|``, see exporter/verify/histogram.py.
    histogram: tuple[int, ...] = ()
    #: The smallest t that would pass as atol and rtol; None where no tolerance would, or none is needed.
    smallest_tolerance: float | None = None
    #: Where a disagreement begins; None where it was not looked for (nothing failed, or the reason says it all).
    bisection: Bisection | None = None

    def to_dict(self) -> dict[str, Any]:
        """As in parity.json."""
        entry: dict[str, Any] = {
            "format": self.format,
            "runtime": self.runtime,
            "output": self.output,
            "kind": self.kind,
            "max_abs_diff": _number(self.max_abs_diff),
            "max_rel_diff": _number(self.max_rel_diff),
            "atol": self.tolerance.atol,
            "rtol": self.tolerance.rtol,
            "passed": self.passed,
            "worst_input": self.worst_input,
        }
        if self.tolerance.reason:
            entry["tolerance_reason"] = self.tolerance.reason
        if self.rounding:
            entry["rounding"] = self.rounding
        if self.reason:
            entry["reason"] = self.reason
        if self.drift:
            entry["drift"] = [_number(d) for d in self.drift]
        if any(self.histogram):
            entry["histogram"] = to_dict(self.histogram)
        if self.smallest_tolerance is not None and not self.passed:
            entry["smallest_tolerance"] = self.smallest_tolerance
        if self.bisection is not None:
            entry["bisection"] = self.bisection.to_dict()
        return entry


def _number(value: float) -> float | str:
    """JSON has no infinities: they are strings."""
    return value if math.isfinite(value) else str(value)


@dataclass(frozen=True, slots=True)
class ParityReport:
    """All comparisons of one policy. ``passed`` is None where no independent runtime ran."""

    policy: str
    passed: bool | None
    seed: int
    samples: int
    reference: str
    runtimes: Mapping[str, Mapping[str, str | None]]
    comparisons: tuple[Comparison, ...]
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
    def failures(self) -> tuple[Comparison, ...]:
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
