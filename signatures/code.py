"""How source code is written: what ``--math``, ``--weights``, ``--outputs`` and ``--guard`` say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from signatures.errors import UsageError
from signatures.records import dataclass

#: Option → what it may say, the usual one first.
CHOICES: Mapping[str, tuple[str, ...]] = {
    "math": ("library", "own"),
}


@dataclass(frozen=True, slots=True)
class CodeOptions:
    """What source code is asked for beside the policy.

    ``math``: the functions of the language's library, or our own, with the same bits on every processor.
    """

    math: str = "library"

    def to_dict(self) -> dict[str, Any]:
        """What is not as usual, as a contract says it."""
        return {key: value for key in CHOICES if (value := getattr(self, key)) != CHOICES[key][0]}

    @classmethod
    def of(cls, tool: Mapping[str, Any]) -> CodeOptions:
        """What a contract says of its source code."""
        return cls(**tool.get("code", {}))


def code_options(**given: Any) -> CodeOptions:
    """What was asked for. Raises UsageError."""
    for key, value in given.items():
        if value not in CHOICES[key]:
            raise UsageError(f"--{key} {value}", fix=f"one of: {', '.join(CHOICES[key])}")
    return CodeOptions(**given)
