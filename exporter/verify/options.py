"""How to verify."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from msgspec import Struct, field
from msgspec.structs import force_setattr

from export_model.exporter.verify.tolerances import Tolerance, ToleranceRule
from export_model.signatures.errors import UsageError, whole


class VerifyOptions(Struct, frozen=True):
    """How to verify."""

    seed: int = 0
    samples: int = 2
    steps: int = 4
    tolerance: Tolerance = field(default_factory=Tolerance)
    #: Other tolerances with their reasons (``--tolerances``); the last rule that covers a comparison decides.
    rules: Sequence[ToleranceRule] = ()
    #: Recorded samples (``--golden``, see exporter/verify/golden.py).
    golden: Path | str | None = None
    #: The most bytes of a format, or of ``total`` (``--max-size``).
    budget: Mapping[str, int] = field(default_factory=dict)
    #: Formats that an independent runtime must have checked, or ``all`` (``--require``); else nothing is decided.
    require: Sequence[str] = ()
    #: Where: ``auto``, ``full``, ``browser``, ``none``, or runtimes by name.
    runtimes: str | Sequence[str] = "auto"

    def __post_init__(self) -> None:
        for name, value, least in (("seed", self.seed, 0), ("samples", self.samples, 1), ("steps", self.steps, 1)):
            force_setattr(self, name, whole(f"--{name}", value, least))
        for name, bound in (("atol", self.tolerance.atol), ("rtol", self.tolerance.rtol)):
            if not math.isfinite(bound) or bound < 0:
                raise UsageError(f"--{name} {bound:g}: must be 0 or more, and finite", fix="leave it out: 1e-05")

    @property
    def flags(self) -> list[str]:
        """The flags of what is to decide otherwise than by default."""
        usual = VerifyOptions()
        changed = {
            "--golden": self.golden is not None,
            "--max-size": bool(self.budget),
            "--tolerances": bool(self.rules),
            "--require": bool(self.require),
            "--samples": self.samples != usual.samples,
            "--steps": self.steps != usual.steps,
            "--seed": self.seed != usual.seed,
            "--atol": self.tolerance.atol != usual.tolerance.atol,
            "--rtol": self.tolerance.rtol != usual.tolerance.rtol,
        }
        return [flag for flag, value in changed.items() if value]

    def check_unverified(self, acting: Collection[str] = ()) -> None:
        """Raise UsageError for what ``--verify none`` leaves without effect; the flags of ``acting`` have one."""
        for flag in self.flags:
            if flag not in acting:
                raise UsageError(
                    f"{flag} needs a verification", why="--verify none was given", fix="leave one of them out"
                )
