"""The graph in the making while a TorchScript program is translated: its tensors, its memory, what is not known yet."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from export_model.converters.files import unpickle
from export_model.converters.files.pickled_objects import Instance
from export_model.converters.files.torchscript_archive import ScriptArchive
from export_model.converters.formats.torchscript.values import LengthFoundError, Module, ScriptTensor, ShapeFoundError
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import NameScope, Node
from export_model.converters.graph.types import BOOL, FLOAT32, INT32, INT64
from export_model.signatures.errors import DamagedFileError, SourceError, UnsupportedOpError

#: c10/core/ScalarType.h: the numbers that a program calls dtypes by.
DTYPES: Mapping[int, np.dtype[Any]] = {
    **dict.fromkeys((5, 6, 7, 15), FLOAT32),
    **dict.fromkeys((0, 1, 2, 3), INT32),
    4: INT64,
    11: BOOL,
}
#: Layers of ``torch.nn`` that are given a history and states, which have so many axes in a batch.
_RECURRENT = re.compile(r"__torch__\.torch\.nn\.modules\.rnn\.(___torch_mangle_\d+\.)?(GRU|LSTM|RNN)")
_LAYER_INPUTS, _STATE_AXES = 2, 3
MEMORY_IN, MEMORY_OUT = "recurrent_in", "recurrent_out"
#: Numbers of a program: lengths and factors.
_MAX_NUMBER = 1 << 62
#: A list of a list of tensors is the deepest that modules have.
_MAX_DEPTH = 8
_TELL = "say what the agent observes: --sensors 48 (one shape per input)"


class Machine:
    """``path`` is the module that is walked through.

    ``memory`` has the shapes of what is fed back: buffers by their keys, and inputs that are states by their names.
    """

    def __init__(self, archive: ScriptArchive, memory: Mapping[str, tuple[int, ...]]) -> None:
        self.b = Builder(NameScope(()))
        self.path = ""
        self.narrowed = False
        self._archive = archive
        self._open: dict[str, tuple[int, int]] = {}
        self._inputs: dict[str, int] = {}
        self._buffers: dict[str, ScriptTensor] = {}
        self._names: dict[str, str] = {}
        self._places: dict[str, tuple[str, int]] = {}
        self._first: dict[str, np.ndarray] = {}
        self._start = self._memory_inputs(memory)

    def _memory_inputs(self, memory: Mapping[str, tuple[int, ...]]) -> dict[str, str]:
        """Return the buffers that are inputs, as the step begins: parts of one input."""
        if not memory:
            return {}
        sizes = [int(np.prod(shape)) for shape in memory.values()]
        whole = self.b.named_input(MEMORY_IN, FLOAT32, (1, sum(sizes)), MEMORY_IN)
        self.b.prefix = "memory"
        found, start = {}, 0
        for (key, shape), size in zip(memory.items(), sizes, strict=True):
            found[key] = self.b.reshape(self.b.slice(whole, 1, start, start + size), shape)
            start += size
        return found

    @contextmanager
    def inside(self, path: str) -> Iterator[None]:
        """Name the nodes that are made by a module."""
        before = self.path, self.b.prefix
        prefix = re.sub(r"[^A-Za-z0-9_/\-]", "_", path.replace(".", "/")).strip("_/")
        self.path, self.b.prefix = path, prefix or "forward"
        try:
            yield
        finally:
            self.path, self.b.prefix = before

    # ------------------------------------------------------------------ inputs and memory

    def input(
        self, name: str, number: int, shape: Sequence[int | None], dtype: np.dtype[Any] = FLOAT32
    ) -> ScriptTensor:
        """Return an input of the program; what its open axes turn out to be is raised as LengthFoundError."""
        reference = self.b.named_input(name, dtype, shape, name)
        for axis, length in enumerate(self.b.shape(reference)):
            if isinstance(length, str):
                self._open[length] = number, axis
                self._inputs[reference] = number
        return ScriptTensor(reference)

    def state(self, name: str) -> ScriptTensor:
        """Return an input that is a part of the memory, as the step begins."""
        return ScriptTensor(self._start[name])

    def place_of(self, symbol: str) -> tuple[int, int]:
        """Return the input and its axis that an open length is of. Raises SourceError where it is of none."""
        if symbol not in self._open:
            raise unknown_length()
        return self._open[symbol]

    def expect_states(self, layer: Module, given: Sequence[Any]) -> None:
        """Raise ShapeFoundError where an input of unknown shape is a state of ``torch.nn``'s recurrent layer.

        ``given`` is what its ``forward`` takes: a batch of histories, and states [layers, 1, hidden].
        """
        if (
            not _RECURRENT.fullmatch(layer.type_name)
            or len(given) != _LAYER_INPUTS
            or not isinstance(given[0], ScriptTensor)
        ):
            return
        states = given[1] if isinstance(given[1], list | tuple) else [given[1]]
        kernel = self.attribute(layer, "weight_hh_l0")
        if self.b.rank(given[0].read()) != _STATE_AXES or not isinstance(kernel, ScriptTensor):
            return
        layers = sum(name.startswith("weight_hh_l") for name in layer.instance.state)
        shape = (layers, 1, self.b.length(kernel.read(), 1))
        for state in (s.read() for s in states if isinstance(s, ScriptTensor)):
            if self.b.rank(state) != _STATE_AXES and state in self._inputs:
                raise ShapeFoundError(self._inputs[state], shape)

    def is_open(self, length: object) -> bool:
        """Whether a length is that of an input, and not known yet."""
        return length in self._open

    def check_closed(self) -> None:
        """Raise SourceError where the length of an input was not told by anything."""
        if self._open:
            raise unknown_length()

    def expect(self, reference: str, axis: int, length: int) -> None:
        """Say what the length of an axis must be. Raises LengthFoundError where it was open, UnsupportedOpError."""
        known = self.b.shape(reference)[self.b.axis(reference, axis)]
        if isinstance(known, str):
            self.place_of(known)
            raise LengthFoundError(known, length)
        if known != length:
            raise UnsupportedOpError(f"an axis of {known} meets one of {length}", why="they must be equally long")

    def written_buffers(self) -> dict[str, tuple[int, ...]]:
        """Return the buffers that the program writes to, in the order of the modules' attributes, and their shapes."""
        return {
            key: tuple(self.b.length(cell.read(), axis) for axis in range(self.b.rank(cell.read())))
            for key, cell in sorted(self._buffers.items(), key=lambda item: self._places[item[0]])
            if cell.version
        }

    def name_of(self, key: str) -> str:
        """Return what a buffer is called in the program."""
        return self._names[key]

    def first_value(self, key: str) -> np.ndarray | None:
        """Return what a buffer holds in the file."""
        return self._first.get(key)

    def finish_memory(self, memory: Mapping[str, tuple[int, ...]], states: Mapping[str, str]) -> None:
        """Make the memory an output: the buffers as they are now, and ``states``, new values by their names."""
        if not memory:
            return
        self.b.prefix = "memory"
        ends = [states[key] if key in states else self._buffers[key].read() for key in memory]
        sizes = [int(np.prod(shape)) for shape in memory.values()]
        parts = [self.b.reshape(end, (1, size)) for end, size in zip(ends, sizes, strict=True)]
        self.output(MEMORY_OUT, self.b.concat(parts, 1))

    def output(self, name: str, reference: str) -> None:
        """Call a tensor by the name of an output."""
        self.b.append(Node(name, "Identity", (reference,), origin=name))

    # ------------------------------------------------------------------ values

    def attribute(self, module: Module, name: str) -> Any:
        """Return an attribute of a module. Raises DamagedFileError where it has none of that name."""
        state = module.instance.state
        if not isinstance(state, dict) or name not in state:
            raise DamagedFileError(
                f"the module {module.path or 'itself'} has no attribute {name[:60]!r}",
                why="its code asks for it",
                fix="copy or download it again",
            )
        place = module.path, [*state].index(name)
        return self._value(state[name], f"{module.path}.{name}" if module.path else name, place)

    def constant(self, value: Any, name: str) -> Any:
        """Return a constant of the program."""
        return self._value(value, name)

    def _value(self, value: Any, name: str, place: tuple[str, int] = ("", 0), depth: int = 0) -> Any:
        if depth > _MAX_DEPTH:
            raise DamagedFileError(f"the attribute {name[:60]} has lists in one another", fix="give it again")
        if isinstance(value, Instance):
            return Module(value, name)
        if isinstance(value, unpickle.PickledTensor):
            return self._buffer(value, name, place)
        if isinstance(value, list | tuple):
            made = [self._value(v, f"{name}.{i}", place, depth + 1) for i, v in enumerate(value)]
            return made if isinstance(value, list) else tuple(made)
        return value if isinstance(value, bool | int | float | str) else None

    def _buffer(self, value: unpickle.PickledTensor, name: str, place: tuple[str, int]) -> ScriptTensor:
        """Return the cell of a tensor in the file; the same for all names of it."""
        key = repr((getattr(value.storage, "key", ""), value.offset, value.shape, value.strides))
        if key not in self._buffers:
            self._first[key] = self._array(value, name)
            reference = self._start.get(key) or self.b.const(self._first[key], name.rpartition(".")[2])
            self._buffers[key] = ScriptTensor(reference, key)
            self._names[key], self._places[key] = name, place
        return self._buffers[key]

    def _array(self, value: unpickle.PickledTensor, name: str) -> np.ndarray:
        array = self._archive.array(value, name)
        if array.dtype.kind == "f":
            self.narrowed |= array.dtype == np.float64 and array.ndim > 0
            return array.astype(FLOAT32)
        if array.dtype.kind in "iu":
            return array.astype(INT64 if array.dtype == np.int64 else INT32)
        if array.dtype.kind == "b":
            return array
        raise DamagedFileError(f"{name} holds no numbers", why=f"its dtype is {array.dtype}", fix="give it again")

    def truth(self, value: Any) -> bool:
        """Return what a condition says. Raises SourceError where it depends on what is fed."""
        if isinstance(value, ScriptTensor):
            known = self.b.constant(value.read())
            if known is None or known.size != 1:
                raise SourceError(
                    "its code decides by what it is fed which way it goes on",
                    why="a graph has one way",
                    fix="export the module to ONNX in its own project (torch.onnx.export), and give that",
                )
            return bool(known.reshape(()))
        if value is None or isinstance(value, bool | int | float | list | tuple):
            return bool(value)
        raise DamagedFileError(f"a {type(value).__name__} is a condition", fix="copy or download it again")

    def number(self, value: Any) -> Any:
        """Return a number within bounds. Raises UnsupportedOpError."""
        if isinstance(value, int) and abs(value) > _MAX_NUMBER:
            raise UnsupportedOpError("a number of its code has more than 62 bits", why="lengths are far smaller")
        return value

    def ref(self, value: Any, like: str | None = None) -> str:
        """Return a tensor of the graph; a number becomes one, of the dtype of ``like`` where that can hold it."""
        if isinstance(value, ScriptTensor):
            return value.read()
        if isinstance(value, bool):
            return self.b.const(np.array(value))
        if isinstance(value, int):
            dtype = INT64 if like is None or self.b.dtype(like) == BOOL else self.b.dtype(like)
            return self.b.const(np.array(self.number(value), dtype))
        if isinstance(value, float):
            return self.b.const(np.array(value, FLOAT32))
        raise UnsupportedOpError(
            f"a {type(value).__name__} is given where a tensor is expected", why="it must be a number"
        )

    def pair(self, left: Any, right: Any) -> tuple[str, str]:
        """Return two operands in one dtype, as PyTorch promotes them; an open length is told by the other's."""
        like = next((v.read() for v in (left, right) if isinstance(v, ScriptTensor)), None)
        a, b = self.ref(left, like), self.ref(right, like)
        kinds = [self.b.dtype(r) for r in (a, b)]
        if kinds[0] != kinds[1]:
            order = (BOOL, INT32, INT64, FLOAT32)
            wide = max(kinds, key=lambda kind: order.index(kind) if kind in order else len(order))
            a, b = self.b.cast(a, wide), self.b.cast(b, wide)
        self.meet(a, b)
        return a, b

    def meet(self, a: str, b: str) -> None:
        """Raise LengthFoundError where an open length meets a known one, from the last axes on."""
        for x, y in zip(self.b.shape(a)[::-1], self.b.shape(b)[::-1], strict=False):
            for symbol, length in ((x, y), (y, x)):
                if isinstance(symbol, str) and isinstance(length, int) and length > 1 and symbol in self._open:
                    raise LengthFoundError(symbol, length)

    def constant_numbers(self, value: Any, meaning: str) -> np.ndarray:
        """Return the numbers of a tensor that is the same in every run: a weight. Raises UnsupportedOpError."""
        if not isinstance(value, ScriptTensor):
            raise UnsupportedOpError(f"{meaning} must be a tensor", why="a weight is expected")
        return self.b.needed_constant(value.read(), meaning)

    def overwrite(self, target: ScriptTensor, made: ScriptTensor) -> None:
        """Put a tensor in another's place. Raises UnsupportedOpError where it does not fit there."""
        before, after = target.read(), made.read()
        self.meet(before, after)
        shape = self.b.shape(before)
        if self.b.shape(after) != shape:
            if self.b.common_shape([shape, self.b.shape(after)]) != shape:
                raise UnsupportedOpError(
                    f"{list(self.b.shape(after))} is written to a tensor of {list(shape)}",
                    why="the code writes in place, and a tensor keeps its shape; here there is one agent",
                )
            after = self.b.broadcast(after, shape)
        target.write(self.b.cast(after, self.b.dtype(before)))


def unknown_length() -> SourceError:
    """Return the refusal of a program that does not say how long an input is."""
    return SourceError(
        "its code does not say how many numbers it observes", why="a scripted module takes any", fix=_TELL
    )
