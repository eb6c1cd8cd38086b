"""How source code is written: what ``--math``, ``--weights``, ``--outputs`` and ``--guard`` say."""

from __future__ import annotations

import math as numbers
from collections.abc import Mapping
from typing import Any

from msgspec import Struct

from export_model.signatures.errors import UsageError

#: What the file of a policy's weights is called that lies beside its source code.
WEIGHTS_FILE = "{name}.weights.bin"
#: Option → what it may say, the usual one first.
CHOICES: Mapping[str, tuple[str, ...]] = {
    "math": ("library", "own"),
    "weights": ("source", "file"),
    "outputs": ("actor", "all"),
}


class CodeOptions(Struct, frozen=True):
    """What source code is asked for beside the policy.

    ``math``: the functions of the language's library, or our own, with the same bits on every processor. ``weights``:
    in the source, or in a file beside it that is loaded. ``outputs``: the actor's, or all. ``guard``: beyond how many
    standard deviations of the policy's own normaliser an observation is unusual (None: nobody asks).
    """

    math: str = "library"
    weights: str = "source"
    outputs: str = "actor"
    guard: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """What is not as usual, as a contract says it."""
        said = {key: value for key in CHOICES if (value := getattr(self, key)) != CHOICES[key][0]}
        return said if self.guard is None else {**said, "guard": self.guard}

    @classmethod
    def of(cls, tool: Mapping[str, Any]) -> CodeOptions:
        """What a contract says of its source code."""
        return cls(**tool.get("code", {}))


def code_options(
    math: str = "library", weights: str = "source", outputs: str = "actor", guard: float | None = None
) -> CodeOptions:
    """What was asked for. Raises UsageError."""
    options = CodeOptions(math, weights, outputs, guard)
    for key, words in CHOICES.items():
        if getattr(options, key) not in words:
            raise UsageError(f"--{key} {getattr(options, key)}: must be {' or '.join(words)}")
    if guard is not None and not (numbers.isfinite(guard) and guard > 0):
        raise UsageError(
            f"--guard {guard:g}: must be more than 0, and finite", why="it counts deviations", fix="such as 6"
        )
    return options
