"""How far apart two runtimes may be. A tolerance other than the default is data with a reason."""

from __future__ import annotations

from dataclasses import dataclass

from signatures.spec import PolicySignature

#: |a − b| ≤ ATOL + RTOL·|b| for every element.
ATOL = RTOL = 1e-5


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Absolute and relative tolerance of an output; ``reason`` is empty for the default."""

    atol: float = ATOL
    rtol: float = RTOL
    reason: str = ""


@dataclass(frozen=True, slots=True)
class _Exception:
    output: str
    algorithm: str | None
    tolerance: Tolerance


_EXCEPTIONS = (
    _Exception(
        "action_probs",
        "SAC",
        Tolerance(5e-3, 5e-3, "log(1 - tanh(x)^2 + eps) cancels where the action saturates (measured: 2.6e-3)"),
    ),
)


def tolerance_for(signature: PolicySignature, output: str, default: Tolerance) -> Tolerance:
    """The tolerance of ``output``: an exception of the table if it is wider than ``default``, else ``default``."""
    for entry in _EXCEPTIONS:
        if entry.output == output and entry.algorithm == signature.algorithm and entry.tolerance.atol > default.atol:
            return entry.tolerance
    return default
