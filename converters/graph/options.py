"""What the user may decide of a policy's graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from converters.graph.passes.noise import NoiseMode
from signatures.roles import Role


@dataclass(frozen=True)
class CompileOptions:
    """The fields are the flags of the command line."""

    names: str = "canonical"  # canonical | source
    noise: NoiseMode = "lift"
    deterministic: bool = False
    brain: str | None = None
    inputs: Mapping[str, Role] = field(default_factory=dict)
    outputs: Mapping[str, Role] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
