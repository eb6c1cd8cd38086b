"""What a writer returns: files, by their path inside the bundle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from converters.policy import Policy


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """What a writer needs beside the policy: the contract as JSON text, and the ONNX opset."""

    contract: str
    opset: int = 15


@dataclass(frozen=True, slots=True)
class Artifact:
    """One format, written: relative path (``/`` between parts) → bytes. ``main`` is the path a loader is given."""

    format: str
    main: str
    files: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes of all files together."""
        return sum(len(data) for data in self.files.values())


Writer = Callable[[Policy, WriteOptions], Artifact]
