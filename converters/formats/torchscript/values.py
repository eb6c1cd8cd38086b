"""What the names of a TorchScript program stand for while it is translated.

Numbers, texts, lists and tuples are Python's own. A tensor is a cell that holds a tensor of the graph: ops in place put
another one into it. A view shares its cell: what is written to it is put where it lies, and what it shows follows.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from export_model.converters.files.pickled_objects import Instance
from export_model.signatures.errors import UnsupportedOpError

#: Of the whole, what a view shows; of the whole and a new view, the new whole.
Show = Callable[[str], str]
Put = Callable[[str, str], str]


class ScriptTensor:
    """A tensor of the program. ``buffer``: the key of the module's attribute that it is, where it is one."""

    def __init__(self, reference: str, buffer: str = "") -> None:
        self._reference = reference
        self.buffer = buffer
        self.version = 0

    def read(self) -> str:
        """Return the tensor of the graph that it is now."""
        return self._reference

    def write(self, reference: str) -> None:
        """Put another tensor of the graph in its place, as ops in place do."""
        self._reference = reference
        self.version += 1


class TensorView(ScriptTensor):
    """A part of a tensor, or all of it under another shape."""

    def __init__(self, whole: ScriptTensor, show: Show, put: Put | None) -> None:
        self._whole, self._show, self._put = whole, show, put
        super().__init__(show(whole.read()))
        self.version = whole.version

    def read(self) -> str:
        """Return what it shows of the whole as it is now."""
        if self._whole_version() != self.version:
            self._reference = self._show(self._whole.read())
            self.version = self._whole_version()
        return self._reference

    def write(self, reference: str) -> None:
        """Put another tensor where it lies. Raises UnsupportedOpError where that cannot be told."""
        if self._put is None:
            raise UnsupportedOpError(
                "it writes to a view of a tensor", why="where this view is in the whole is not followed"
            )
        self._whole.write(self._put(self._whole.read(), reference))
        self._reference, self.version = reference, self._whole_version()

    def _whole_version(self) -> int:
        self._whole.read()  # a view of a view
        return self._whole.version


class Module(Struct, frozen=True):
    """A module of the program: its attributes, and where it is (``actor.0``)."""

    instance: Instance
    path: str = ""

    @property
    def type_name(self) -> str:
        """The class, with the file that it stands in: ``__torch__.torch.nn.modules.linear.Linear``."""
        return f"{self.instance.maker.module}.{self.instance.maker.name}"


class Named(Struct, frozen=True):
    """Something that is called by a dotted name: an op (``torch.relu``), a function of the program."""

    name: str


class Device(Struct, frozen=True):
    """Where a tensor would lie, which makes no difference here."""


class OpenLength(Struct, frozen=True):
    """The length of an input's axis that is not known yet, as a number of the program: it may be compared."""

    symbol: str


class ShapeFoundError(Exception):
    """The shape of a whole input, told by the layer that it is a state of: the program is read again."""

    def __init__(self, number: int, shape: tuple[int, ...]) -> None:
        super().__init__(number, shape)
        self.number, self.shape = number, shape


class LengthFoundError(Exception):
    """The length of an axis that a scripted module does not say, told by what reads it: the program is read again."""

    def __init__(self, symbol: str, length: int) -> None:
        super().__init__(symbol, length)
        self.symbol, self.length = symbol, length
