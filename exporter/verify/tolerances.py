"""How far apart two runtimes may be. A tolerance other than the default is data with a reason."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from msgspec import Struct

from export_model.signatures.errors import UsageError
from export_model.signatures.spec import PolicySignature

#: |a − b| ≤ ATOL + RTOL·|b| for every element.
ATOL = RTOL = 1e-5


class Tolerance(Struct, frozen=True):
    """Absolute and relative tolerance of an output; ``reason`` is empty for the default."""

    atol: float = ATOL
    rtol: float = RTOL
    reason: str = ""


class ToleranceRule(Struct, frozen=True):
    """A tolerance for some comparisons; None stands for every policy, format, runtime or output."""

    tolerance: Tolerance
    policy: str | None = None
    format: str | None = None
    runtime: str | None = None
    output: str | None = None

    @property
    def names(self) -> str:
        """What it is for, in words."""
        parts = {n: getattr(self, n) for n in ("policy", "format", "runtime", "output")}
        return ", ".join(f"{n} {v!r}" for n, v in parts.items() if v is not None)

    def covers(self, policy: str, kind: str, runtime: str, output: str) -> bool:
        """Whether this rule is for the comparison; a format covers all signatures of a SavedModel."""
        wanted = (self.policy, self.format, self.runtime, self.output)
        found = (policy, kind.partition(":")[0], runtime, output)
        return all(w is None or w == f for w, f in zip(wanted, found, strict=True))


#: (output, algorithm) → what it is held to instead
_EXCEPTIONS = {
    ("action_probs", "SAC"): Tolerance(
        5e-3,
        5e-3,
        "log(1 - tanh(x)^2 + eps) cancels where the action saturates (measured: 2.6e-3, and 4.7e-2 above 8)",
    )
}


def tolerance_for(signature: PolicySignature, output: str, default: Tolerance) -> Tolerance:
    """The tolerance of ``output``: an exception of the table if it is wider than ``default``, else ``default``."""
    known = _EXCEPTIONS.get((output, signature.algorithm or ""), default)
    return known if known.atol > default.atol else default


def tolerance_by_rules(
    rules: Sequence[ToleranceRule], policy: str, kind: str, runtime: str, output: str
) -> Tolerance | None:
    """What a user's rules say of a comparison: the last one that covers it decides; None where none does."""
    return next((r.tolerance for r in reversed(rules) if r.covers(policy, kind, runtime, output)), None)


def check_rules(
    rules: Sequence[ToleranceRule],
    policies: Mapping[str, Collection[str]],
    formats: Mapping[str, Collection[str]],
    runtimes: Collection[str],
) -> None:
    """Raise UsageError where a user's rule can cover no comparison: a name in it is mistyped, or it is not run.

    ``policies`` has the outputs of each, ``formats`` the runtimes that run each, ``runtimes`` are those that will.
    """
    run = {key: {*names} & {*runtimes} for key, names in formats.items()}
    pairs = [*((key, name) for key, names in run.items() for name in names), ("reference", "numpy")]
    pairs += [(key, name) for key in ("golden", "source") for name in runtimes]
    for number, rule in enumerate(rules, 1):
        outputs = (o for name, found in policies.items() for o in found if rule.policy in (None, name))
        covered = any(rule.output in (None, o) for o in outputs)
        if covered and any(rule.format in (None, f) and rule.runtime in (None, r) for f, r in pairs):
            continue
        known = dict.fromkeys(o for found in policies.values() for o in found)
        raise UsageError(
            f"--tolerances: entry {number} covers no comparison",
            why=f"it is for {rule.names}; outputs: {', '.join(known)}; "
            f"run: {', '.join(f'{key} in {name}' for key, name in pairs if key in formats) or 'nothing'}",
            fix="correct its names, or take it out",
        )
