"""A TorchScript module as PyTorch loads it, for one agent; its memory is fed and fetched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch


class ScriptedModule:
    """The module of a file.

    ``inputs`` are [name, shape for one agent] of what ``forward`` is given, in order; ``states`` those of them that are
    given back behind the action; ``buffers`` are [path of the attribute, shape] of the memory inside.
    """

    def __init__(self, path: str, inputs: Sequence[Any], buffers: Sequence[Any], states: Sequence[str]) -> None:
        import torch

        self._module = torch.jit.load(path, map_location="cpu").eval()
        self._inputs, self._buffers, self._states = inputs, buffers, states

    def __call__(self, feeds: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the outputs by the names that the reader of the file gives them, and the memory after."""
        import torch

        feeds = dict(feeds)
        shapes = dict(self._inputs)
        parts = [(name, shapes[name]) for name in self._states] + list(self._buffers)
        if parts:
            memory = feeds["recurrent_in"].reshape(-1).split([math.prod(shape) for _, shape in parts])
            for (name, shape), part in zip(parts, memory, strict=True):
                if name in self._states:
                    feeds[name] = part
                else:
                    self._buffer(name).copy_(part.reshape(shape))
        given = [feeds[name] if None in shape else feeds[name].reshape(shape) for name, shape in self._inputs]
        result = self._module(*given)
        results = list(result) if isinstance(result, tuple) else [result]
        acting = results[: len(results) - len(self._states)]
        after = [*results[len(acting) :], *(self._buffer(name) for name, _ in self._buffers)]
        names = ["action"] if len(acting) == 1 else [f"output_{i}" for i in range(len(acting))]
        answers = dict(zip(names, acting, strict=True))
        if after:
            answers["recurrent_out"] = torch.cat([part.reshape(1, -1) for part in after], 1)
        return {name: answer.clone() for name, answer in answers.items()}

    def _buffer(self, path: str) -> torch.Tensor:
        found = self._module
        for name in path.split("."):
            found = getattr(found, name)
        return found
