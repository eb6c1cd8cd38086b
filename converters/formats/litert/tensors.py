"""The tensors of a subgraph as the file has them, each held against the bytes that are there."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable

import numpy as np

from export_model.converters.formats.litert.flatbuffer import Table
from export_model.converters.formats.litert.schema import TYPES
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, UnsupportedOpError

_DTYPES = {number: dtype for dtype, (number, _) in TYPES.items()}
#: What policies compute in: halves and doubles are computed as float32.
_COMPUTED = {np.dtype(np.float16): FLOAT32, np.dtype(np.float64): FLOAT32}
_UNREAD = (np.dtype(np.uint32), np.dtype(np.uint64))
_MAX_AXES = 32
#: What a tensor is called that the file has no name for: by its number. A writer leaves such names out.
UNNAMED = re.compile(r"tensor_\d+")
#: How often the bytes of a file may stand in the constants of a graph (equal weights share theirs), and bytes beyond.
_REPEATED, _FREE = 4, 1 << 20


def damaged_error(why: str) -> DamagedFileError:
    """The error of a file that does not hold together."""
    return DamagedFileError("the .tflite file is damaged", why=why, fix="fetch or convert it again")


def entry_of(table: Table, vector: str, number: int) -> Table:
    """An entry of a vector. Raises DamagedFileError."""
    entries = table.get(vector, ())
    if not 0 <= number < len(entries):
        raise damaged_error(f"it has no {vector}[{number}]")
    found: Table = entries[number]
    return found


def dtype_of(tensor: Table) -> np.dtype | None:
    """The dtype of a tensor, None for texts and others that are no numbers."""
    return _DTYPES.get(tensor.get("type", 0))


def dims_of(tensor: Table) -> tuple[int | None, ...]:
    """The lengths of a tensor's axes; None is a free one."""
    shape: list[int] = list(tensor["shape_signature"] if "shape_signature" in tensor else tensor.get("shape", ()))
    return tuple(None if n < 0 else int(n) for n in shape)


def needed_operators(subgraph: Table, outputs: Iterable[int], inputs: Iterable[int]) -> list[Table]:
    """The operators that make the outputs of inputs, in the file's order."""
    fed, found = frozenset(inputs), list[Table]()
    wanted = set(outputs) - fed
    for operator in reversed(subgraph.get("operators", ())):
        made = {int(i) for i in operator.get("outputs", ())}
        if made & wanted:
            wanted = (wanted - made) | ({int(i) for i in operator.get("inputs", ())} - fed)
            found.append(operator)
    return found[::-1]


class Tensors:
    """The tensors of a subgraph by their numbers; ``size`` is the length of the file."""

    def __init__(self, model: Table, subgraph: Table, size: int) -> None:
        self.model, self.subgraph = model, subgraph
        self._left = _REPEATED * size + _FREE
        named = [str(t.get("name") or f"tensor_{i}") for i, t in enumerate(subgraph.get("tensors", ()))]
        often = Counter(named)
        #: what the file calls each; one without a name of its own is called by its number
        self.names = [n if often[n] == 1 else f"tensor_{i}" for i, n in enumerate(named)]
        self._known: dict[tuple[int, int, tuple[int, ...]], np.ndarray] = {}

    def _table(self, number: int) -> Table:
        return entry_of(self.subgraph, "tensors", number)

    def name(self, number: int) -> str:
        """What a tensor is called, as no other is. Raises DamagedFileError."""
        self._table(number)
        return self.names[number]

    def dtype(self, number: int) -> np.dtype:
        """What a tensor is computed in. Raises NotAPolicyError."""
        dtype = dtype_of(self._table(number))
        if dtype is None or dtype in _UNREAD:
            kind = self._table(number).get("type", 0) if dtype is None else dtype
            raise NotAPolicyError(
                f"the tensor {self.name(number)!r} holds neither floats, integers nor booleans that are read",
                why=f"its type is {kind}; policies compute in float32",
                fix="give the graph it was converted from",
            )
        return _COMPUTED.get(dtype, dtype)

    def dims(self, number: int) -> tuple[int | None, ...] | None:
        """The lengths of a tensor's axes; None where the file says that its rank is not known."""
        tensor = self._table(number)
        found = dims_of(tensor)
        if len(found) > _MAX_AXES:
            raise damaged_error(f"tensor {number} has {len(found)} axes")
        return found

    def check_plain(self, number: int, kind: str) -> None:
        """Raise UnsupportedOpError where an operator computes with a tensor that is quantised, sparse or a state."""
        if number == -1:
            return
        tensor = self._table(number)
        if "scale" in tensor.get("quantization", {}) and len(tensor["quantization"]["scale"]):
            dtype = dtype_of(tensor)
            if dtype is not None and dtype.kind in "iu":
                raise _unsupported_error(
                    f"the tensor {self.name(number)!r}, with which {kind} computes, is quantised to {dtype}",
                    "of a model that computes in integers runtimes give different results",
                    "give the float32 model that it was made of (weights alone in float16 or int8 are read)",
                )
        if "sparsity" in tensor:
            raise _unsupported_error(
                f"the tensor {self.name(number)!r} is kept in a sparse form", None, "convert the model without it"
            )
        if tensor.get("is_variable"):
            raise _unsupported_error(
                f"the tensor {self.name(number)!r} keeps its value from one call to the next",
                "the memory of a policy is an input and an output",
                "give the model it was converted from, or convert one whose memory is an input and an output",
            )

    def constant(self, number: int) -> np.ndarray | None:
        """The numbers of a constant as the file keeps them; None where it has none. Raises DamagedFileError."""
        tensor = self._table(number)
        buffer = int(tensor.get("buffer", 0))
        dtype, shape = dtype_of(tensor), tuple(int(n) for n in tensor.get("shape", ()))
        data = entry_of(self.model, "buffers", buffer).get("data") if buffer else None
        if data is None or len(data) == 0:
            return np.zeros(shape, dtype) if dtype is not None and 0 in shape and min(shape) == 0 else None
        if dtype is None or len(shape) > _MAX_AXES or min(shape, default=0) < 0:
            raise damaged_error(f"the constant {self.name(number)!r} has no numbers, or lengths below 0")
        if math.prod(shape) * dtype.itemsize != len(data):
            said = f"has {len(data)} bytes, which are not of the shape {list(shape)[:8]}"
            raise damaged_error(f"the constant {self.name(number)!r} {said}")
        key = (buffer, dtype.num, shape)
        if key not in self._known:
            self._count(len(data))
            self._known[key] = np.frombuffer(data, dtype.newbyteorder("<")).reshape(shape)
            if dtype == np.bool_:  # a byte that is neither 0 nor 1 is true
                self._known[key] = np.frombuffer(data, np.uint8).reshape(shape) != 0
        return self._known[key]

    def widened(self, number: int) -> np.ndarray | None:
        """The floats that a constant in fewer bytes stands for; None where it is computed. Raises DamagedFileError."""
        value, kept = self.constant(number), self._table(number).get("quantization", {})
        if value is None or "sparsity" in self._table(number):
            return None
        self._count(4 * value.size)
        if value.dtype == np.float16:
            return value.astype(FLOAT32)
        scale, zero = (np.asarray(kept.get(key, ()), np.float64) for key in ("scale", "zero_point"))
        axis = int(kept.get("quantized_dimension", 0))
        zero = zero if zero.size else np.zeros(1)
        several = scale.size > 1
        if value.dtype.kind not in "iu" or not scale.size or zero.size not in (1, scale.size):
            raise damaged_error(f"the constant {self.name(number)!r} does not say which floats it encodes")
        if several and (not 0 <= axis < value.ndim or value.shape[axis] != scale.size):
            raise damaged_error(
                f"the constant {self.name(number)!r} has {scale.size} scales for another number of channels"
            )
        sizes = [-1 if several and i == axis else 1 for i in range(value.ndim)]
        steps, zeros = scale.astype(FLOAT32).reshape(sizes), np.broadcast_to(zero, scale.shape).reshape(sizes)
        return np.asarray((value.astype(np.int64) - zeros.astype(np.int64)).astype(FLOAT32) * steps, FLOAT32)

    def _count(self, size: int) -> None:
        self._left -= size
        if self._left < 0:
            raise damaged_error(f"its constants name the same bytes more than {_REPEATED} times over")


def _unsupported_error(what: str, why: str | None, fix: str) -> UnsupportedOpError:
    return UnsupportedOpError(what, why=why, fix=fix)
