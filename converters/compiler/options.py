"""What the user may decide of a policy's graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from msgspec import Struct, field

from export_model.signatures.roles import Role

#: A policy's placeholders, and its outputs.
MAX_PORTS = 1 << 10
#: What becomes of the normals that are drawn inside the graph: an input, they stay, or zeros.
NoiseMode = Literal["lift", "keep", "zero"]


class CompileOptions(Struct, frozen=True):
    """The fields are the flags of the command line."""

    #: canonical or source; None: canonical, or the consumer's
    names: str | None = None
    #: None: ``lift``, or what the consumer does with noise
    noise: NoiseMode | None = None
    deterministic: bool = False
    brain: str | None = None
    inputs: Mapping[str, Role] = field(default_factory=dict)
    outputs: Mapping[str, Role] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
