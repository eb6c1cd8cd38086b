"""Pickles as data: a machine that knows plain containers, PyTorch's tensors and numpy's scalars, and calls nothing.

A pickle is a program that may import and call anything, so the standard library's machine is not used: opcodes are
taken apart by ``pickletools.genops`` (which runs nothing) and carried out here. ``pickle.Unpickler`` with inert stubs
in ``find_class`` would run nothing either, but it takes memory as the file says: four bytes of LONG_BINPUT make it
allocate 32 GiB for its memo, a BYTEARRAY8 as many as it names, before anything of the file is read. The names that a
pickle imports are looked up in a fixed table, whose entries make values of this module; any other name is refused by
name. Opcodes: CPython Lib/pickletools.py; what torch.save writes: torch/serialization.py, torch/_utils.py.
"""

from __future__ import annotations

import pickletools
import re
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import IO, Any, Literal

import numpy as np
from msgspec import Struct

from export_model.signatures.errors import DamagedFileError, NotAPolicyError

#: A checkpoint has some thousands of opcodes; with a critic and an optimizer some ten thousands.
MAX_OPCODES = 1 << 21
#: Items that its calls (OrderedDict, Size) may copy in all: a call of few bytes copies whatever the memo holds.
MAX_COPIED = 1 << 20
#: Of a tensor: kernels of images have four, and no axis is longer than a file can be.
MAX_AXES, MAX_LENGTH = 8, 1 << 31
#: PyTorch's magic number has 77.
_MAX_BITS = 1 << 10
_FIX = "give a checkpoint as its trainer wrote it"
MARK = object()
KEYS = (str, int, float, bool, type(None))


class StorageType(Struct, frozen=True):
    """A class such as ``torch.FloatStorage``: which numbers a storage holds (numpy's name of their dtype)."""

    dtype: str


class PickledTensor(Struct, frozen=True):
    """A tensor as it is pickled: a storage, where in it the tensor begins, and the steps along each axis (elements)."""

    storage: Any
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class Function(Struct, frozen=True):
    """An imported name that may be called; ``make`` gets the arguments and gives a value of this module."""

    name: str
    make: Callable[[tuple[Any, ...]], Any]


class PickledDtype(Struct):
    """A numpy dtype as it is pickled: its code, and the state that says its byte order."""

    code: Any
    state: Any = None

    def numbers(self) -> np.dtype[Any] | None:
        """Return the dtype where it is of plain numbers; else None."""
        order = self.state[1] if isinstance(self.state, tuple) and len(self.state) > 1 else "="
        if not isinstance(self.code, str) or not _PLAIN_DTYPE.fullmatch(self.code) or order not in _ORDERS:
            return None
        return np.dtype(self.code).newbyteorder(_ORDERS[order])


#: What numpy calls a dtype of numbers in a pickle, and how it marks their byte order.
_PLAIN_DTYPE = re.compile("f[248]|[iu][1248]|b1")
_ORDERS: Mapping[Any, Literal["<", ">", "="]] = {"<": "<", ">": ">", "|": "=", "=": "="}
#: Where numpy keeps what makes arrays and scalars, before numpy 2 and since.
MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")

_STORAGES = {
    "Float": "float32",
    "Double": "float64",
    "Half": "float16",
    "BFloat16": "bfloat16",
    "Long": "int64",
    "Int": "int32",
    "Short": "int16",
    "Char": "int8",
    "Byte": "uint8",
    "Bool": "bool",
}


def unpickle(stream: IO[bytes], storage: Callable[[tuple[Any, ...]], Any]) -> Any:
    """The value of one pickle; the stream stands behind it then.

    ``storage`` makes what a persistent id stands for. Raises NotAPolicyError for a name that is not in the table,
    DamagedFileError for a pickle that breaks the rules of its own format.
    """
    return carry_out(PickleMachine(storage), stream)


def carry_out(machine: PickleMachine, stream: IO[bytes]) -> Any:
    """Return the value of one pickle, its opcodes carried out by a machine. Raises what ``unpickle`` raises."""
    try:
        with warnings.catch_warnings():  # of escapes in a damaged name, by pickletools
            warnings.simplefilter("ignore")
            for count, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
                if count > MAX_OPCODES:
                    raise damaged_error(f"its pickle has more than {MAX_OPCODES} opcodes")
                if opcode.name == "STOP":
                    return machine.pop()
                machine.run(opcode.name, argument)
    except (ValueError, IndexError, KeyError, OverflowError, TypeError, AttributeError) as error:
        text = str(error).strip().splitlines()
        raise damaged_error(f"its pickle cannot be read: {text[0] if text else type(error).__name__}") from error
    raise damaged_error("its pickle has no end")


class PickleMachine:
    """The stack and the memo of a pickle; ``opcodes`` are those that it carries out."""

    def __init__(self, storage: Callable[[tuple[Any, ...]], Any]) -> None:
        self.opcodes: Mapping[str, Callable[[Any, Any], object]] = OPCODES
        self.storage = storage
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.copied = 0

    def run(self, name: str, argument: Any) -> None:
        """Carry out one opcode."""
        if name not in self.opcodes:
            raise NotAPolicyError(
                f"its pickle asks for what no checkpoint needs (opcode {name})",
                why="only plain containers and tensors are built from a checkpoint; nothing in it is run",
                fix=_FIX,
            )
        self.opcodes[name](self, argument)

    def push(self, value: Any) -> None:
        """Put a value on the stack."""
        if isinstance(value, int) and value.bit_length() > _MAX_BITS:  # Python would not write it as text
            raise damaged_error(f"its pickle holds a number of {value.bit_length()} bits")
        self.stack.append(value)

    def pop(self) -> Any:
        """The top of the stack."""
        value = self.stack.pop()
        if value is MARK:
            raise damaged_error("its pickle takes a mark for a value")
        return value

    def last(self, count: int) -> tuple[Any, ...]:
        """So many values from the top of the stack, in the order in which they were put there."""
        return tuple([self.pop() for _ in range(count)][::-1])

    def items(self) -> list[Any]:
        """What stands above the last mark, which goes too."""
        for at in range(len(self.stack) - 1, -1, -1):
            if self.stack[at] is MARK:
                found = self.stack[at + 1 :]
                del self.stack[at:]
                return found
        raise damaged_error("its pickle asks for a mark that is not there")

    def top(self, kind: type) -> Any:
        """The container that is being filled."""
        if not isinstance(self.stack[-1], kind):
            raise damaged_error(f"its pickle fills something other than a {kind.__name__}")
        return self.stack[-1]

    def extend(self, values: Sequence[Any]) -> None:
        """Put values into the list that is at the top."""
        self.top(list).extend(values)

    def fill(self, items: Sequence[Any]) -> None:
        """Put keys and values, by turns, into the dictionary that is at the top."""
        target = self.top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, KEYS):
                raise damaged_error(f"a key in its pickle is a {type(key).__name__}")
            target[key] = value

    def push_dict(self, items: Sequence[Any]) -> None:
        """Put a new dictionary of these keys and values on the stack."""
        self.stack.append({})
        self.fill(items)

    def stack_global(self) -> Any:
        """The name that two texts on the stack are."""
        module, name = self.last(2)
        if not isinstance(name, str) or not isinstance(module, str):
            raise damaged_error("its pickle imports something that has no name")
        return self.import_name(module, name)

    def import_name(self, module: str, name: str) -> Any:
        """Return what an imported name stands for. Raises NotAPolicyError where it is not in the table."""
        return _global(module, name)

    def reduce(self) -> Any:
        """What a call gives."""
        function, arguments = self.last(2)
        if not isinstance(function, Function) or not isinstance(arguments, tuple):
            raise damaged_error("its pickle calls something other than a function")
        self.copied += sum(len(a) for a in arguments if isinstance(a, tuple | list | dict | str | bytes))
        if self.copied > MAX_COPIED:
            raise damaged_error(f"the calls of its pickle copy more than {MAX_COPIED} items")
        return function.make(arguments)

    def build(self) -> None:
        """Attributes of a container: a state dictionary's ``_metadata``, which only PyTorch's loader looks at."""
        state = self.pop()
        if isinstance(self.stack[-1], PickledDtype):
            self.stack[-1].state = state
        else:
            self.top(dict)

    def persistent(self) -> Any:
        """What a persistent id stands for."""
        identity = self.pop()
        if not isinstance(identity, tuple):
            raise damaged_error("a persistent id in its pickle must be a tuple")
        return self.storage(identity)


_VALUES = (
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
)
#: What each opcode does with the machine and its argument.
OPCODES: dict[str, Callable[[PickleMachine, Any], object]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda m, _: None),
    **dict.fromkeys(_VALUES, PickleMachine.push),
    "MARK": lambda m, _: m.stack.append(MARK),
    "NONE": lambda m, _: m.stack.append(None),
    "NEWTRUE": lambda m, _: m.stack.append(True),
    "NEWFALSE": lambda m, _: m.stack.append(False),
    "EMPTY_TUPLE": lambda m, _: m.stack.append(()),
    "EMPTY_LIST": lambda m, _: m.stack.append([]),
    "EMPTY_DICT": lambda m, _: m.stack.append({}),
    "TUPLE": lambda m, _: m.stack.append(tuple(m.items())),
    "TUPLE1": lambda m, _: m.stack.append(m.last(1)),
    "TUPLE2": lambda m, _: m.stack.append(m.last(2)),
    "TUPLE3": lambda m, _: m.stack.append(m.last(3)),
    "LIST": lambda m, _: m.stack.append(m.items()),
    "APPEND": lambda m, _: m.extend(m.last(1)),
    "APPENDS": lambda m, _: m.extend(m.items()),
    "DICT": lambda m, _: m.push_dict(m.items()),
    "SETITEM": lambda m, _: m.fill(m.last(2)),
    "SETITEMS": lambda m, _: m.fill(m.items()),
    "POP": lambda m, _: m.stack.pop(),
    "POP_MARK": lambda m, _: m.items(),
    "DUP": lambda m, _: m.stack.append(m.stack[-1]),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), lambda m, index: m.memo.update({index: m.stack[-1]})),
    "MEMOIZE": lambda m, _: m.memo.update({len(m.memo): m.stack[-1]}),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda m, index: m.stack.append(m.memo[index])),
    **dict.fromkeys(("GLOBAL", "INST"), lambda m, name: m.stack.append(m.import_name(*name.partition(" ")[::2]))),
    "STACK_GLOBAL": lambda m, _: m.stack.append(m.stack_global()),
    "REDUCE": lambda m, _: m.stack.append(m.reduce()),
    "BUILD": lambda m, _: m.build(),
    "BINPERSID": lambda m, _: m.stack.append(m.persistent()),
}


# ------------------------------------------------------------------ the names that are known


def _ordered_dict(arguments: tuple[Any, ...]) -> dict[Any, Any]:
    """An OrderedDict, its items given as pairs or set later; dictionaries keep their order here."""
    made: dict[Any, Any] = {}
    for pair in arguments[0] if arguments else ():
        key, value = pair
        if not isinstance(key, KEYS):
            raise damaged_error(f"a key in its pickle is a {type(key).__name__}")
        made[key] = value
    return made


def _tensor(arguments: tuple[Any, ...]) -> PickledTensor:
    """``_rebuild_tensor_v2(storage, storage_offset, size, stride, requires_grad, backward_hooks, metadata)``."""
    storage, offset, shape, strides = arguments[:4]
    if not isinstance(shape, tuple) or not isinstance(strides, tuple) or len(shape) != len(strides):
        raise damaged_error("a tensor's shape and strides do not fit together")
    if len(shape) > MAX_AXES or not all(_is_count(n) for n in (offset, *shape, *strides)):
        raise damaged_error("a tensor's shape or strides are none")
    return PickledTensor(storage, offset, shape, strides)


def _encode(arguments: tuple[Any, ...]) -> bytes:
    """Return ``_codecs.encode(text, "latin1")``, with which older protocols write bytes."""
    text, *coding = arguments
    if not isinstance(text, str) or coding not in (["latin1"], ["latin-1"]):
        raise damaged_error("its pickle encodes something that is not bytes")
    return text.encode("latin1")


def _dtype(arguments: tuple[Any, ...]) -> PickledDtype:
    return PickledDtype(arguments[0] if arguments else None)


def _scalar(arguments: tuple[Any, ...]) -> bool | int | float:
    """``scalar(dtype, bytes)``: a number of numpy's, as training keeps of its returns."""
    dtype, data = arguments
    numbers = dtype.numbers() if isinstance(dtype, PickledDtype) else None
    if numbers is None:
        raise refusal(MULTIARRAY[-1], "scalar")
    if not isinstance(data, bytes) or len(data) != numbers.itemsize:
        raise damaged_error("a scalar in its pickle does not have the bytes of its dtype")
    value: bool | int | float = np.frombuffer(data, numbers)[0].item()
    return value


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < MAX_LENGTH


NAMES: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): Function("OrderedDict", _ordered_dict),
    ("torch._utils", "_rebuild_tensor"): Function("_rebuild_tensor", _tensor),
    ("torch._utils", "_rebuild_tensor_v2"): Function("_rebuild_tensor_v2", _tensor),
    # of its data, requires_grad, backward_hooks: the data
    ("torch._utils", "_rebuild_parameter"): Function("_rebuild_parameter", lambda arguments: arguments[0]),
    ("_codecs", "encode"): Function("encode", _encode),
    ("numpy", "dtype"): Function("dtype", _dtype),
    **{(module, "scalar"): Function("scalar", _scalar) for module in MULTIARRAY},
    ("torch", "Size"): Function("Size", lambda arguments: tuple(arguments[0])),
    **{("torch", f"{kind}Storage"): StorageType(dtype) for kind, dtype in _STORAGES.items()},
    **{("torch.cuda", f"{kind}Storage"): StorageType(dtype) for kind, dtype in _STORAGES.items()},
}


#: Modules whose functions act on the machine that loads a pickle: no object that is kept in one needs them.
SYSTEM = frozenset(
    (
        *("os", "posix", "nt", "subprocess", "sys", "builtins", "__builtin__", "runpy", "socket", "shutil"),
        *("importlib", "pty", "ctypes", "multiprocessing", "threading", "asyncio", "pickle", "webbrowser", "code"),
    )
)
#: What the module of a name tells: (modules, why it is refused, what to do). The last row is for all others.
_OTHERS: tuple[tuple[Collection[str], str, str], ...] = (
    (
        ("torch.nn", "torch.optim", "torch.distributions"),
        "the module was saved whole, and its code is not in the file",
        "save the weights alone, torch.save(policy.state_dict(), …); or export the module with torch.onnx.export",
    ),
    (
        ("numpy", "gym", "gymnasium", "stable_baselines3", "omegaconf", "argparse", "pandas", "ray", "tensorboard"),
        "it holds settings, statistics or data beside the weights, as objects of that library",
        "give the checkpoint with the weights; or save them alone: torch.save(policy.state_dict(), …)",
    ),
    (
        SYSTEM,
        "loading it as a pickle would run that, which no weights need",
        f"do not load it with torch.load or pickle; {_FIX}",
    ),
    (
        (),
        "a class or function of a project is not in the file, only its name",
        "save the weights alone, torch.save(policy.state_dict(), …); or export the module with torch.onnx.export",
    ),
)


def _global(module: str, name: str) -> Any:
    found = NAMES.get((module, name))
    if found is None:
        raise refusal(module, name)
    return found


def refusal(module: str, name: str) -> NotAPolicyError:
    """Return the refusal of a name that a pickle imports."""
    parts = module[:100].split(".")
    above = {".".join(parts[:n]) for n in range(1, len(parts) + 1)}
    _, why, fix = next(row for row in _OTHERS if not row[0] or not above.isdisjoint(row[0]))
    built = "only tensors and plain containers are built from a checkpoint, and nothing in it is run"
    return NotAPolicyError(f"its pickle asks for {module[:100]}.{name[:100]}", why=f"{built}; {why}", fix=fix)


def damaged_error(what: str) -> DamagedFileError:
    """Return the refusal of a pickle that breaks the rules of its own format."""
    return DamagedFileError(what, why="the file is cut off or damaged", fix="copy or download it again")
