"""A state dictionary: tensors by name, each taken once, so that nothing in it goes unread."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from export_model.converters.files.unpickle import PickledTensor
from export_model.signatures.errors import DamagedFileError, SourceError


class TensorFile(Protocol):
    """A file that tensors lie in: ``value`` is what was saved, ``array`` a tensor's numbers."""

    value: Any

    def array(self, tensor: PickledTensor, name: str) -> np.ndarray:
        """Return the numbers of a tensor of the file; ``name`` is for errors. Raises DamagedFileError."""
        ...


class ArraysByName:
    """Arrays that are read already, as a file's tensors."""

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.value: Any = {name: PickledTensor(a, 0, a.shape, ()) for name, a in arrays.items()}

    def array(self, tensor: PickledTensor, name: str) -> np.ndarray:
        """Return a tensor's numbers."""
        found: np.ndarray = tensor.storage
        return found


class Weights:
    """The tensors of one module.

    ``holder`` is what errors call it, ``maker`` who builds such networks, ``fix`` what to do where one is not
    understood.
    """

    def __init__(self, archive: TensorFile, tensors: Mapping[Any, Any], *, holder: str, maker: str, fix: str) -> None:
        self._archive, self._holder, self._maker, self._fix = archive, holder, maker, fix
        self._tensors: Mapping[str, PickledTensor] = {
            k: v for k, v in tensors.items() if isinstance(k, str) and isinstance(v, PickledTensor)
        }
        self._left = {str(name) for name in tensors}
        self._read: dict[str, np.ndarray] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a tensor; raises DamagedFileError where there is none of that name."""
        if name not in self._tensors:
            raise self.damaged_error(
                f"{self._holder} has no {name}", "the other weights belong to a network that has one"
            )
        return self._tensors[name].shape

    def length(self, name: str, axis: int) -> int:
        """The length of an axis of a tensor; raises DamagedFileError where it has none."""
        shape = self.shape(name)
        if not -len(shape) <= axis < len(shape):
            raise self.damaged_error(f"{name} has the shape {list(shape)}", "it lacks an axis that such a weight has")
        return shape[axis]

    def array(self, name: str, *shape: int | None) -> np.ndarray:
        """A tensor as float32, its shape checked (None: any length). Raises DamagedFileError."""
        found = self.shape(name)
        if len(found) != len(shape) or any(w is not None and w != n for w, n in zip(shape, found, strict=False)):
            wanted = ", ".join("?" if n is None else str(n) for n in shape)
            raise self.damaged_error(
                f"{name} has the shape {list(found)}, and [{wanted}] fits the network",
                f"it is of a network that {self._maker} did not build, or damaged",
            )
        array = self._archive.array(self._tensors[name], name)
        if array.dtype.kind not in "fiu":
            raise self.damaged_error(f"{name} holds no numbers", f"its dtype is {array.dtype}")
        self._left.discard(name)
        self._read[name] = array
        return array.astype(np.float32)

    def arrays(self) -> Mapping[str, np.ndarray]:
        """Return the tensors that were read, as the file has them."""
        return self._read

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
        self._left = {n for n in self._left if not n.startswith(prefixes)}

    def check_all_read(self) -> None:
        """Raise SourceError where there are parts that are not known."""
        if self._left:
            names = sorted(self._left)
            shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
            raise self.unsupported_error(shown, f"it is part of no network that {self._maker} builds without plugins")

    def damaged_error(self, what: str, why: str) -> DamagedFileError:
        """The refusal of weights that do not fit together."""
        return DamagedFileError(what, why=why, fix=self._fix)

    def unsupported_error(self, what: str, why: str) -> SourceError:
        """The refusal of a network that is not built here."""
        return SourceError(f"its network has a part that is not read from a checkpoint: {what}", why=why, fix=self._fix)


def pytorch_alone(maker: str, what: str = "it") -> str:
    """The note on a file that nothing runs which a verification could ask."""
    return (
        f"no runtime but PyTorch with {maker} reads {what}: unless --verify torch builds its network, its "
        "formats are compared with each other only (self-consistent)"
    )
