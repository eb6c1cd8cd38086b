"""LiteRT's operators into a graph, one by one: tensors get names, constants their numbers."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from export_model.converters.formats.litert.flatbuffer import Table
from export_model.converters.formats.litert.importer.operator import LiteRTOp, Translate
from export_model.converters.formats.litert.tensors import UNNAMED, Tensors, damaged_error
from export_model.converters.formats.onnx.importer.importer import node_name
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.dilation import Blocks
from export_model.converters.graph.nodes import NameScope, Node, TensorShape, ref
from export_model.converters.graph.ops.base import MISFIT
from export_model.signatures.errors import UnsupportedOpError

#: Operators with weights, and the axes of these as TensorFlow has them: (columns, rows), (height, width, in, out).
KERNELS = {"FULLY_CONNECTED": (1, 0), "CONV_2D": (1, 2, 3, 0)}


class LiteRTImporter(Builder):
    """The builder of a subgraph's graph.

    ``ports`` are the tensors that are fed, by their numbers, with the names that a caller uses. ``stored`` are the
    names of weights whose axes this tool turned when it wrote the file (``tensor_map``); None: another tool wrote it.
    """

    def __init__(self, tensors: Tensors, ports: Mapping[int, str], stored: Collection[str] | None) -> None:
        super().__init__(NameScope(()))
        self.tensors, self.stored = tensors, stored
        #: number of a tensor → its reference in the graph
        self.values: dict[int, str] = {}
        #: whether anything was widened from fewer bits, or narrowed from more
        self.widened = self.narrowed = False
        #: weights that have their axes in TensorFlow's order
        self.kernels: set[str] = set()
        #: position of the node that cut a tensor into blocks → that tensor, and how
        self.blocks: dict[int, tuple[str, Blocks]] = {}
        self._turned: dict[tuple[int, tuple[int, ...]], str] = {}
        for number, port in ports.items():
            self._input(number, port)

    def _input(self, number: int, port: str) -> None:
        if number in self.values:
            raise damaged_error(f"tensor {number} is an input twice")
        dims = TensorShape(self.tensors.dims(number))
        attrs = {"dtype": self.tensors.dtype(number), "shape": dims}
        name = self.names.fresh(node_name(port))
        self.values[number] = self.append(Node(name, "Placeholder", attrs=attrs, origin=port))

    def node_named(self, number: int) -> str:
        """A free name for the node that stands for a tensor; of several tensors that one layer became, the last's."""
        return self.names.fresh(node_name(self.tensors.name(number).rpartition(";")[2]))

    def operand(self, number: int) -> str | None:
        """The reference of a tensor that an operator reads; None where it is left out. Raises DamagedFileError."""
        if number == -1:
            return None
        if number not in self.values:
            value = self.tensors.constant(number)
            if value is None:
                raise damaged_error(
                    f"tensor {number} ({self.tensors.name(number)!r}) is read, and nothing makes it before that"
                )
            self.values[number] = self._constant(number, value)
        return self.values[number]

    def _constant(self, number: int, value: np.ndarray) -> str:
        self.narrowed |= value.dtype == np.float64
        self.widened |= value.dtype == np.float16
        kept = value.astype(self.tensors.dtype(number), copy=False)
        return self.append(Node(self.node_named(number), "Const", value=kept, origin=self.tensors.name(number)))

    def is_unnamed(self, reference: str) -> bool:
        """Whether a constant has no name in the file."""
        return UNNAMED.fullmatch(reference) is not None

    def _kernel(self, number: int, axes: tuple[int, ...]) -> str | None:
        """The weights of a layer in TensorFlow's order, ``axes`` of what the file has; noted in ``kernels``.

        Weights that are computed stay as they are, and those that this tool wrote in the order that they had.
        """
        value = None if number == -1 or number in self.values else self.tensors.constant(number)
        name = self.tensors.name(number) if value is not None else ""
        if value is None or value.ndim != len(axes) or (self.stored is not None and name not in self.stored):
            return self.operand(number)
        if (number, axes) not in self._turned:
            self._turned[number, axes] = self._constant(number, value.transpose(axes))
            self.kernels.add(self._turned[number, axes])
        return self._turned[number, axes]

    def translate(self, operator: Table, kind: str, table: Mapping[str, Translate]) -> None:
        """Make what an operator becomes. Raises UnsupportedOpError, DamagedFileError, GraphError."""
        inputs, outputs = ([int(i) for i in operator.get(side, ())] for side in ("inputs", "outputs"))
        if not outputs or any(i in self.values for i in outputs) or len(set(outputs)) < len(outputs):
            raise damaged_error(f"an operator {kind} makes nothing, or tensors that were made before")
        name = self.tensors.name(outputs[0])
        if kind == "DEQUANTIZE":
            self._widen(kind, name, inputs, outputs)
            return
        function = table.get(kind)
        if function is None:
            raise _unknown_operator_error(kind, name)
        for number in (*inputs, *outputs):
            self.tensors.check_plain(number, kind)
        dtypes = tuple(self.tensors.dtype(i) for i in outputs)
        axes = KERNELS.get(kind)
        read = [self._kernel(n, axes) if axes and i == 1 else self.operand(n) for i, n in enumerate(inputs)]
        op = LiteRTOp(kind, name, tuple(read), operator.get("builtin_options", {}), dtypes)
        node = self.node_named(outputs[0])
        self.prefix, started = node, len(self.nodes)
        try:
            results = function(op, self)
        except UnsupportedOpError as error:
            raise (error if error.issues else op.refusal(error.what, error.why, error.fix)) from error
        except MISFIT as error:
            why = f"{type(error).__name__}: {error}"
            raise op.refusal("it has operands or options that LiteRT does not allow", why) from error
        made = [results] if isinstance(results, str) else list(results)
        if len(made) != len(outputs):
            raise damaged_error(f"{kind} (tensor {name!r}) has {len(outputs)} results instead of {len(made)}")
        whole = len(made) > 1 and made == [ref(made[0], i) for i in range(len(made))]
        first = self._finish(made[0], started, node, name)
        self.values[outputs[0]] = first
        for index, number in enumerate(outputs[1:], 1):
            self.values[number] = ref(first, index) if whole else made[index]
        self.prefix = ""

    def _finish(self, value: str, started: int, name: str, origin: str) -> str:
        """Call the node behind ``value`` ``name``; one from before ``started``, or a constant, gets an Identity."""
        at = self.position.get(value, -1)
        new = at >= started and self.nodes[at].op != "Const" and value not in self.lengths.values()
        if new and not any(value in n.inputs for n in self.nodes[started:]):
            several = self.outputs(value)
            made = self.rename(value, name, origin)
            for index in range(1, several):
                self.types[ref(made, index)] = self.types.pop(ref(value, index))
            return made
        return self.append(Node(name, "Identity", (value,), origin=origin))

    def _widen(self, kind: str, name: str, inputs: list[int], outputs: list[int]) -> None:
        """Weights that are kept in fewer bytes, as the floats that they stand for."""
        value = self.tensors.widened(inputs[0]) if len(inputs) == len(outputs) == 1 else None
        if value is None:
            raise LiteRTOp(kind, name, (), {}, ()).refusal(
                "it turns integers that the model computes with into floats", _INTEGERS, _FLOATS
            )
        self.widened = True
        origin = self.tensors.name(outputs[0])
        self.values[outputs[0]] = self.append(Node(self.node_named(outputs[0]), "Const", value=value, origin=origin))


_INTEGERS = "the model is quantised: it computes in integers, which not all formats have, and of which runtimes differ"
_FLOATS = "give the float32 model that it was made of (weights alone in float16 or int8 are read)"
#: How the names of operators begin or end that are not converted → why, and what to do.
_REASONS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (
        ("UNIDIRECTIONAL", "BIDIRECTIONAL", "LSTM", "RNN", "SVDF", "VAR_", "READ_", "ASSIGN_", "CALL_"),
        "it keeps a memory in the interpreter from call to call, where a policy's is an input and an output",
        "give the model it was converted from, or convert one whose memory is an input and an output",
    ),
    (("QUANTIZE", "FAKE_"), _INTEGERS, _FLOATS),
    (("WHILE", "IF"), "loops and branches are not read from .tflite files", "give the graph it was converted from"),
    (("Flex", "FLEX"), "it is an op of TensorFlow, which LiteRT alone does not run", "give the SavedModel itself"),
)


def _unknown_operator_error(kind: str, name: str) -> UnsupportedOpError:
    op = LiteRTOp(kind, name, (), {}, ())
    for beginnings, why, fix in _REASONS:
        if kind.startswith(beginnings):
            return op.refusal("it is not read", why, fix)
    return op.refusal("no entry of the table of LiteRT's operators covers it")
