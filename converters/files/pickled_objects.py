"""Pickled objects as data: the names of their classes, their attributes, numpy's arrays. Nothing is imported or called.

``unpickle.py`` refuses objects: a checkpoint needs none. Some files are made of them (VecNormalize of
Stable-Baselines3). Here an object is an ``Instance``: what its class is called, and what the pickle would give it. An
object of any class may stand beside those that a reader asks for, and is left alone; a name that acts on the machine
(``os.system``) is refused, though it would not be called either.

Sources: CPython Lib/pickletools.py; numpy/_core/src/multiarray/methods.c (``array_reduce``: ``_reconstruct`` and the
state (version, shape, dtype, Fortran order, bytes)), descriptor.c (``arraydescr_reduce``), numpy/_core/numeric.py
(``_frombuffer``, of protocol 5); modules were called ``numpy.core`` before numpy 2.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from msgspec import Struct

from export_model.converters.files.unpickle import (
    KEYS,
    MULTIARRAY,
    NAMES,
    OPCODES,
    SYSTEM,
    Function,
    PickledDtype,
    PickleMachine,
    carry_out,
    damaged_error,
    refusal,
)

#: Types of Python that objects are pickled with.
_PLAIN_TYPES = frozenset(
    (
        *("object", "set", "frozenset", "slice", "complex", "bytearray", "range"),
        *("list", "tuple", "dict", "int", "float", "bool", "str", "bytes"),
    )
)
_BUILTINS = frozenset(("builtins", "__builtin__"))
#: What protocols 0 and 1 make an object of a class with (Lib/copyreg.py).
_RECONSTRUCTORS = (("copy_reg", "_reconstructor"), ("copyreg", "_reconstructor"))
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")
_MAX_AXES = 32


class Name(Struct, frozen=True):
    """An imported class or function, by its name alone."""

    module: str
    name: str


class Instance(Struct, dict=True):
    """An object: what made it (a class, or a function), what that was given, and the state that was set afterwards."""

    maker: Name
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def attribute(self, name: str, default: Any = None) -> Any:
        """Return an attribute; the default where the object has none of that name."""
        state = self.state
        if isinstance(state, tuple) and len(state) == 2:  # those of __dict__, those of __slots__
            state = {k: v for part in state[::-1] if isinstance(part, dict) for k, v in part.items()}
        return state.get(name, default) if isinstance(state, dict) else default


def unpickle_objects(
    data: bytes,
    storage: Callable[[tuple[Any, ...]], Any] | None = None,
    names: Mapping[tuple[str, str], Any] | None = None,
    *,
    functions: bool = False,
) -> Any:
    """Return the value of a pickle that may hold objects.

    ``storage`` makes what a persistent id stands for; ``names`` are functions of this program, for names that the
    pickle calls. ``functions``: it may describe functions (as cloudpickle does), whose code names builtins; they stay
    names, as all others.

    Raises NotAPolicyError for a name that acts on the machine, DamagedFileError for what breaks the rules of pickles.
    """
    machine = _Objects(storage or _no_storage, names or {})
    machine.refused_modules = SYSTEM - _BUILTINS if functions else SYSTEM
    return carry_out(machine, io.BytesIO(data))


def _no_storage(identity: tuple[Any, ...]) -> Any:
    raise damaged_error("found a tensor where another value is expected")


class _Objects(PickleMachine):
    """A machine for which every other class is a name."""

    def __init__(self, storage: Callable[[tuple[Any, ...]], Any], names: Mapping[tuple[str, str], Any]) -> None:
        super().__init__(storage)
        self._names = {**{name: made for name, made in NAMES.items() if name[1] != "scalar"}, **names}
        self.opcodes = _OPCODES
        self.refused_modules = SYSTEM

    def import_name(self, module: str, name: str) -> Any:
        """Return what is known of an imported name. Raises NotAPolicyError for one that acts on the machine."""
        if (module, name) in self._names:
            return self._names[module, name]
        root = module.partition(".")[0]
        if root in self.refused_modules and not (root in _BUILTINS and name in _PLAIN_TYPES):
            raise refusal(module, name)
        return Name(module, name)

    def reduce(self) -> Any:
        """Return the object that a call would make, or what a known function gives."""
        function, arguments = self.last(2)
        if isinstance(function, Function):
            self.stack += [function, arguments]
            return super().reduce()
        return self.instance(function, arguments)

    def instance(self, maker: Any, arguments: Any) -> Instance:
        """Return an object that is not made. A class may be one that the pickle describes (cloudpickle does)."""
        maker = maker.maker if isinstance(maker, Instance) else maker
        if not isinstance(maker, Name) or not isinstance(arguments, tuple):
            raise damaged_error("its pickle makes an object of something that is not a class")
        if (maker.module, maker.name) in _RECONSTRUCTORS and arguments and isinstance(arguments[0], Name):
            return Instance(arguments[0])
        return Instance(maker, arguments)

    def build(self) -> None:
        """Set the state of the object at the top; attributes of a container are left out."""
        state = self.pop()
        target = self.stack[-1]
        if isinstance(target, Instance | PickledDtype):
            target.state = state
        elif not isinstance(target, dict | list):
            raise damaged_error("its pickle sets the state of something that has none")

    def collect_instance(self) -> Instance:
        """Return an object of its class and arguments, all above a mark."""
        maker, *arguments = self.items()
        return self.instance(maker, tuple(arguments))

    def extend(self, values: Any) -> None:
        """Put values into the list that is at the top; those of an object (a deque) are left out."""
        if not isinstance(self.stack[-1], Instance):
            super().extend(values)

    def fill(self, items: Any) -> None:
        """Put items into the dictionary that is at the top; keys that are no plain values are left out."""
        if isinstance(self.stack[-1], Instance):  # of a subclass of dict
            self.stack[-1].state = {k: v for k, v in zip(items[::2], items[1::2], strict=True) if isinstance(k, KEYS)}
            return
        target = self.top(dict)
        target.update({k: v for k, v in zip(items[::2], items[1::2], strict=True) if isinstance(k, KEYS)})


_OPCODES = {
    **OPCODES,
    "NEWOBJ": lambda m, _: m.stack.append(m.instance(*m.last(2))),
    "NEWOBJ_EX": lambda m, _: m.stack.append(m.instance(*m.last(3)[:2])),
    "OBJ": lambda m, _: m.stack.append(m.collect_instance()),
    "INST": lambda m, name: m.stack.append(m.instance(m.import_name(*name.partition(" ")[::2]), tuple(m.items()))),
    "BYTEARRAY8": lambda m, value: m.stack.append(bytes(value)),
    **dict.fromkeys(("STRING", "BINSTRING", "SHORT_BINSTRING"), lambda m, value: m.stack.append(value)),
    # Sets hold no statistics: what goes into one is forgotten.
    "EMPTY_SET": lambda m, _: m.stack.append([]),
    "ADDITEMS": lambda m, _: m.items(),
    "FROZENSET": lambda m, _: m.stack.append(m.items()),
}


# ------------------------------------------------------------------ numpy


def array_of(value: Any, what: str) -> np.ndarray:
    """Return a pickled array or scalar of numbers, or a number of Python, as an array of its dtype.

    ``what`` is its name in errors. Raises DamagedFileError where it is something else.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        return np.array(value, np.float64)
    if isinstance(value, Instance):
        module, name = value.maker.module, value.maker.name
        if module in MULTIARRAY and name == "_reconstruct" and isinstance(value.state, tuple):
            shape, dtype, fortran, data = value.state[-4:] if len(value.state) >= 4 else (None,) * 4
            return _array(shape, dtype, data, "F" if fortran is True else "C", what)
        if module in _NUMERIC and name == "_frombuffer" and len(value.arguments) == 4:
            data, dtype, shape, order = value.arguments
            return _array(shape, dtype, data, "F" if order == "F" else "C", what)
        if module in MULTIARRAY and name == "scalar" and len(value.arguments) == 2:
            return _array((), value.arguments[0], value.arguments[1], "C", what)
    raise damaged_error(f"its {what} is not an array of numbers")


def _array(shape: Any, dtype: Any, data: Any, order: Literal["C", "F"], what: str) -> np.ndarray:
    kind = dtype.numbers() if isinstance(dtype, PickledDtype) else None
    whole = isinstance(shape, tuple) and all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in shape)
    if kind is None or not whole or len(shape) > _MAX_AXES or not isinstance(data, bytes):
        raise damaged_error(f"its {what} is not an array of numbers")
    if math.prod(shape) * kind.itemsize != len(data):
        raise damaged_error(f"its {what} has {len(data)} bytes, and its shape {list(shape)[:8]} needs others")
    return np.frombuffer(data, kind).reshape(shape, order=order).astype(kind.newbyteorder("="), copy=False)
