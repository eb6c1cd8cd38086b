"""The state dictionary of an actor: tensors by name, each taken once, so that nothing in it goes unread."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from converters.torch_checkpoint.archive import Archive
from converters.torch_checkpoint.unpickle import Tensor
from signatures.errors import DamagedFileError, NotAPolicyError, SourceError

#: What a reader of a checkpoint can always do instead: ML-Agents writes the ONNX when it saves.
LET_IT_EXPORT = (
    "let ML-Agents export the ONNX: mlagents-learn <config> --resume --run-id <id> in the project it was trained in, "
    "stopped at once with Ctrl-C; then give the .onnx"
)
#: Parts of the saved actor that an exported policy does not have: the critic of 0.22 to 0.24, a shared critic's heads.
_NOT_POLICY = ("critic.", "value_heads.")


class State:
    """The tensors of ``Policy``; ``step_is_float``: its step counter is one of ML-Agents 0.20 and 0.21."""

    def __init__(self, archive: Archive) -> None:
        """Find the actor in a checkpoint. Raises NotAPolicyError where there is none."""
        value = archive.value
        policy = value.get("Policy") if isinstance(value, dict) else None
        if policy is None and isinstance(value, dict) and "version_number" in value:
            policy = value  # the actor's own state dictionary, saved by hand
        if not isinstance(policy, dict) or not _is_actor(policy):
            raise NotAPolicyError(
                "is no checkpoint of ML-Agents",
                why=f"it holds {_content(value)}; a checkpoint of ML-Agents holds Policy, with version_number and "
                "network_body in it",
                fix="a state dictionary does not say what is computed with it: export the model to ONNX in its own "
                "project (torch.onnx.export), and give that",
            )
        self._archive = archive
        self._tensors: Mapping[str, Tensor] = {k: v for k, v in policy.items() if isinstance(v, Tensor)}
        self._left = {name for name in policy if not str(name).startswith(_NOT_POLICY)}
        self.modules = sorted(str(k) for k in value) if policy is not value else []
        self.step_is_float = _step_is_float(value)

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a tensor; raises DamagedFileError where there is none of that name."""
        if name not in self._tensors:
            raise DamagedFileError(
                f"its Policy has no {name}",
                why="what stands beside it belongs to a network that has one",
                fix=LET_IT_EXPORT,
            )
        return self._tensors[name].shape

    def length(self, name: str, axis: int) -> int:
        """The length of an axis of a tensor; raises DamagedFileError where it has none."""
        shape = self.shape(name)
        if not -len(shape) <= axis < len(shape):
            raise DamagedFileError(
                f"{name} has the shape {list(shape)}", why="it lacks an axis that such a weight has", fix=LET_IT_EXPORT
            )
        return shape[axis]

    def array(self, name: str, *shape: int | None) -> np.ndarray:
        """A tensor as float32, its shape checked (None: any length). Raises DamagedFileError."""
        found = self.shape(name)
        if len(found) != len(shape) or any(w is not None and w != n for w, n in zip(shape, found, strict=False)):
            wanted = ", ".join("?" if n is None else str(n) for n in shape)
            raise DamagedFileError(
                f"{name} has the shape {list(found)}, and [{wanted}] fits the network",
                why="the checkpoint is of a network that ML-Agents did not build, or damaged",
                fix=LET_IT_EXPORT,
            )
        array = self._archive.array(self._tensors[name], name)
        if array.dtype.kind not in "fiu":
            raise DamagedFileError(f"{name} holds no numbers", why=f"its dtype is {array.dtype}", fix=LET_IT_EXPORT)
        self._left.discard(name)
        return array.astype(np.float32)

    def number(self, name: str) -> float:
        """A tensor of one element."""
        array = self.array(name, *([1] * len(self.shape(name))))
        return float(array.reshape(()))

    def indices(self, prefix: str) -> list[int]:
        """The numbers that follow ``prefix`` in the names (the members of a ModuleList), in order."""
        pattern = re.compile(re.escape(prefix) + r"(\d{1,6})\.")
        return sorted({int(m[1]) for m in map(pattern.match, self._tensors) if m is not None})

    def under(self, prefix: str) -> list[str]:
        """The names that begin with ``prefix``, without it."""
        return [n.removeprefix(prefix) for n in self._tensors if n.startswith(prefix)]

    def forget(self, *prefixes: str) -> None:
        """Say that tensors are second names of others, or facts that are not needed."""
        self._left = {n for n in self._left if not str(n).startswith(prefixes)}

    def check_all_read(self) -> None:
        """Raise SourceError where the actor has parts that are not known."""
        if self._left:
            names = sorted(str(n) for n in self._left)
            shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
            raise unknown_part(shown, "it is part of no network that ML-Agents builds without plugins")


def unknown_part(what: str, why: str) -> SourceError:
    """The refusal of a network that is not built here."""
    return SourceError(f"its network has a part that is not read from a checkpoint: {what}", why=why, fix=LET_IT_EXPORT)


def _is_actor(policy: Mapping[Any, Any]) -> bool:
    names = [k for k in policy if isinstance(k, str)]
    return "version_number" in names and any(n.startswith("network_body.") for n in names)


def _content(value: Any) -> str:
    if not isinstance(value, dict):
        return f"a {type(value).__name__.lower()}" if not isinstance(value, Tensor) else "one tensor"
    return _listed(k for k in value if isinstance(k, str)) or "nothing that has a name"


def _listed(names: Iterable[str]) -> str:
    found = [n[:60] for n in names]
    return ", ".join(found[:6]) + (f" and {len(found) - 6} more" if len(found) > 6 else "")


def _step_is_float(value: Mapping[str, Any]) -> bool:
    steps = value.get("global_step")
    step = steps.get("_GlobalSteps__global_step") if isinstance(steps, dict) else None
    return isinstance(step, Tensor) and str(getattr(step.storage, "dtype", "")).startswith("float")
