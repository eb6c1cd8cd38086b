"""A policy as ML-Agents of the ``.nn`` years (0.7 to release 16) expects it: names, memories, constants, layers.

=====================  ============================================================================================
``vector_observation``  all vectors of the policy, one after the other
``visual_observation_i``  images as [H, W, C], in the policy's order
``action_masks``        where a discrete policy has none, one is put in front of its scores
``prev_action``         as floats
``epsilon``             the first noise input; further ones are drawn by the model, since nobody feeds them
memories                each part of the state [1, 1, 1, size]: ``recurrent_in_c``, ``recurrent_out_c``, …
``action``              continuous: the action; discrete: the log-probabilities of all branches, from which ML-Agents
                        draws (hybrid: ``continuous_actions`` and ``discrete_actions``)
constants               ``version_number`` 2, ``memory_size``, ``is_continuous_control``, ``action_output_shape``
=====================  ============================================================================================

Source: ``BarracudaModelParamLoader`` and ``TensorGenerator`` of ML-Agents 0.7 to release 20. What such a policy gives
besides (``value_estimate``, ``action_probs``, a deterministic action of its own) is written too. The action without
chance is not where it is made here: it is the largest score of each branch, or the action at ``epsilon`` 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from converters.compiler.targets import BARRACUDA, prepare
from converters.formats.barracuda.assemble import assemble
from converters.formats.barracuda.format import NnInput, NnMemory, NnModel
from converters.formats.barracuda.lower_arrays import as_row, join_along, reshape_value
from converters.formats.barracuda.lower_base import NnBuilder
from converters.formats.barracuda.lower_linear import FORBIDDEN, best_score, noise
from converters.formats.barracuda.lower_table import lower_graph
from converters.formats.barracuda.lower_values import FREE, Axes, Dims, Piece, Value
from converters.formats.barracuda.vocabulary import Activation, C, H, LayerType, N, W
from converters.graph.nodes import Graph, Node, node_of
from converters.graph.ops.table import passes_on, traits
from converters.graph.shapes import infer_types
from converters.graph.types import BATCH, Dim
from converters.policy.policy import Policy
from signatures.errors import SignatureError
from signatures.records import dataclass
from signatures.roles import (
    ACTION_NAMES,
    ACTION_SHAPE,
    CONSTANT_NAMES,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION_NUMBER,
    Role,
)
from signatures.spec import TensorSpec

#: What ML-Agents calls the layout of names and constants that is written here.
API_VERSION = 2

_IMAGE: Axes = (0, 1, 2, 3)
_IMAGE_NCHW: Axes = (0, 3, 1, 2)
#: What ML-Agents calls the inputs that there is one of.
INPUT_NAMES = {Role.MASKS: "action_masks", Role.PREV_ACTION: "prev_action", Role.NOISE: "epsilon"}
_EXTRA = {Role.VALUE: "value_estimate", Role.ACTION_PROBS: "action_probs"}
#: The parts of a memory that does not say of how many it is made; ML-Agents asks for a ``_c`` and a ``_h``.
_PARTS = ("c", "h")


def policy_model(policy: Policy) -> NnModel:
    """The policy as a model of version 16. Raises UnsupportedOpError, SignatureError.

    One in the names of a consumer (``Policy.constants``) keeps them.
    """
    return dressed_model(policy) if policy.constants else _Lowering(policy).model()


def base_name(spec: TensorSpec) -> str:
    """An output's name without the scope of its brain, which names of the source have."""
    return spec.name.rpartition("/")[2]


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of the recurrent state: its names and its size."""

    taken: str
    given: str
    size: int


class _Lowering:
    def __init__(self, policy: Policy) -> None:
        self.policy, self.signature = policy, policy.signature
        self.graph: Graph = prepare(policy, BARRACUDA)
        self.inputs: list[NnInput] = []
        self.parts = self._memory_parts()
        self.heads = [s for s in self.signature.outputs if base_name(s) in ACTION_NAMES]
        taken = [*ACTION_NAMES, *CONSTANT_NAMES, *INPUT_NAMES.values(), *_EXTRA.values()]
        cameras = (f"visual_observation_{i}" for i in range(len(self.signature.inputs)))
        taken += ["vector_observation", "recurrent_in", *cameras]
        taken += [name for part in self.parts for name in (part.taken, part.given)]
        taken += [base_name(spec) for spec in self.signature.outputs]
        self.b = NnBuilder(infer_types(self.graph), taken)
        self.outputs: list[str] = []

    def model(self) -> NnModel:
        given = self._input_values()
        results = {spec.name: self._result(spec) for spec in self.signature.outputs}
        wanted = [r for r in results.values() if r is not None]
        memory = self.signature.memory
        if memory is not None and memory.output is not None:
            wanted.append(self.policy.fetches[memory.output])
        scores = self._scores()
        values = lower_graph(self.b, self.graph, given, [*wanted, *scores])
        for spec in self.signature.outputs:
            reference = results[spec.name]
            if spec in self.heads:
                self._action(spec, [values[r] for r in scores] if reference is None else [values[reference]])
            elif reference is not None:
                self._output(_EXTRA.get(spec.role, base_name(spec)), as_row(self.b, values[reference]))
        if memory is not None and memory.output is not None:
            self._memories_out(as_row(self.b, values[self.policy.fetches[memory.output]]))
        return self._assemble()

    # ------------------------------------------------------------------ inputs

    def _input_values(self) -> dict[str, Value]:
        """Placeholder → the input of the file that it is, or is a part of."""
        given: dict[str, Value] = {}
        self._vectors(given)
        cameras = [s for s in self.signature.inputs if s.role is Role.VISUAL]
        for number, spec in enumerate(cameras):
            self._camera(given, number, spec)
        for role, name in INPUT_NAMES.items():
            for number, spec in enumerate(s for s in self.signature.inputs if s.role is role):
                if number == 0:
                    given[self._feed(spec)] = self._input(name, (FREE, 1, 1, self._width(spec)))
                elif role is Role.NOISE:
                    self.b.node = Node(spec.name, "Placeholder")
                    given[self._feed(spec)] = noise(self.b, self._shape(spec))
        self._memories_in(given)
        return given

    def _vectors(self, given: dict[str, Value]) -> None:
        vectors = [s for s in self.signature.inputs if s.role is Role.VECTOR]
        if not vectors:
            return
        widths = [self._width(s) for s in vectors]
        whole = self._input("vector_observation", (FREE, 1, 1, sum(widths)))
        start = 0
        for spec, width in zip(vectors, widths, strict=True):
            shape = self._shape(spec)
            part = self.b.cut(whole, start, start + width, (BATCH, width))
            given[self._feed(spec)] = reshape_value(self.b, part, shape)
            start += width

    def _camera(self, given: dict[str, Value], number: int, spec: TensorSpec) -> None:
        shape = self._shape(spec)
        axes = _IMAGE_NCHW if self.signature.preprocess.get(spec.name, {}).get("layout") == "NCHW" else _IMAGE
        dims = Value(shape, axes).dims
        name = f"visual_observation_{number}"
        self._input(name, dims)
        given[self._feed(spec)] = self.b.layer_value(name, shape, axes)

    def _input(self, name: str, dims: Dims) -> Value:
        """An input of the file as a tensor [B, …] whose axes lie as they do in the file."""
        self.inputs.append(NnInput(name, dims))
        self.b.note_input(name, dims)
        return Value((BATCH, dims[C]), (N, C), (Piece(name, dims[C], 0, dims[C]),))

    def _feed(self, spec: TensorSpec) -> str:
        return node_of(self.policy.feeds[spec.name])

    def _shape(self, spec: TensorSpec) -> tuple[Dim, ...]:
        shape: list[Dim] = [BATCH if d is None and i == 0 else d or 0 for i, d in enumerate(spec.shape)]
        if not shape or shape[0] != BATCH or 0 in shape:
            raise self._input_error(
                spec, f"it has the shape {list(spec.shape)}", "an input has a row per agent, of a known length"
            )
        return tuple(shape)

    def _width(self, spec: TensorSpec) -> int:
        return Value(self._shape(spec)).size

    def _input_error(self, spec: TensorSpec, what: str, why: str) -> SignatureError:
        return SignatureError(
            f"{spec.name!r} ({spec.role.value}) cannot be written to a .nn: {what}",
            why=why,
            fix="leave nn out of --to: the other formats hold it",
        )

    # ------------------------------------------------------------------ memories

    def _memory_parts(self) -> list[_Part]:
        """The parts of the state: those that the policy names, else two halves."""
        memory = self.signature.memory
        if memory is None or memory.input is None:
            return []
        if memory.output is None:
            raise SignatureError(
                "the policy takes a memory and gives none, which a .nn cannot say",
                where=self.policy.name,
                why="the file that it was read from has lost the memory's output",
                fix="export the file that has it, or leave nn out of --to",
            )
        layout = memory.layout
        if len(layout) < 2 or memory.size % len(layout):
            if memory.size < 2:
                raise SignatureError(
                    "a memory of one number cannot be written to a .nn",
                    where=self.policy.name,
                    why="ML-Agents asks for a memory in two parts",
                    fix="leave nn out of --to: the other formats hold it",
                )
            sizes = [memory.size - memory.size // 2, memory.size // 2]
            layout = _PARTS
        else:
            sizes = [memory.size // len(layout)] * len(layout)
        parts = []
        for number, (part, size) in enumerate(zip(layout, sizes, strict=True)):
            group = sum(p == part for p in layout[:number])
            suffix = f"_{group}_{part}" if group else f"_{part}"
            parts.append(_Part(f"recurrent_in{suffix}", f"recurrent_out{suffix}", size))
        return parts

    def _memories_in(self, given: dict[str, Value]) -> None:
        memory = self.signature.memory
        if memory is None or memory.input is None:
            return
        pieces = []
        for part in self.parts:
            self.b.note_input(part.taken, (FREE, 1, 1, part.size))
            pieces.append(Piece(part.taken, part.size, 0, part.size))
        spec = self.signature.input(memory.input)
        whole = Value((BATCH, memory.size), (N, C), tuple(pieces))
        given[self._feed(spec)] = reshape_value(self.b, whole, self._shape(spec))

    def _memories_out(self, state: Value) -> None:
        start = 0
        for part in self.parts:
            piece = self.b.cut(state, start, start + part.size, (BATCH, part.size))
            self.b.name_tensor(part.given, self.b.stored_name(piece))
            start += part.size

    # ------------------------------------------------------------------ outputs

    def _result(self, spec: TensorSpec) -> str | None:
        """The tensor of the graph that an output of the file is made from; None: it is not written, or by scores."""
        if spec in self.heads and spec.role is Role.SAMPLED:
            return next(self.policy.fetches[s.name] for s in self.signature.outputs if s.role is Role.LOG_PROBS)
        if spec in self.heads and spec.role is Role.DETERMINISTIC and self._discrete(spec):
            return None
        if spec in self.heads or spec.role in _EXTRA or self._own_quiet(spec):
            return self.policy.fetches[spec.name]
        return None

    def _own_quiet(self, spec: TensorSpec) -> bool:
        """An action without chance that the source has itself: of some trainers, not the one at no noise."""
        return spec.role is Role.DETERMINISTIC and spec.source is not None and spec.dtype == "float32"

    def _discrete(self, spec: TensorSpec) -> bool:
        name = base_name(spec)
        return name == "discrete_actions" or (name == "action" and self.signature.action_space == "discrete")

    def _scores(self) -> list[str]:
        """Where the discrete action is the best class: the scores of each branch."""
        for spec in self.heads:
            if spec.role is Role.DETERMINISTIC and self._discrete(spec):
                return _scores_behind(self.graph, self.policy.fetches[spec.name], self.b)
        return []

    def _action(self, spec: TensorSpec, values: Sequence[Value]) -> None:
        b = self.b
        b.node = Node(base_name(spec), "Identity")
        rows = [as_row(b, v) for v in values]
        if not self._discrete(spec):
            self._output(base_name(spec), rows[0])
            return
        if spec.role is Role.DETERMINISTIC:
            best = [best_score(b, b.stored_name(r), r.size, f"branch_{i}") for i, r in enumerate(rows)]
            rows = [b.layer_value(name, r.shape, r.axes) for name, r in zip(best, rows, strict=True)]
        width = sum(r.size for r in rows)
        row = join_along(b, rows, 1, (BATCH, width))
        if spec.role is Role.PROBS:
            row = b.layer_value(b.activation(Activation.LOG, b.stored_name(row), label="log"), row.shape, row.axes)
        if not any(s.role is Role.MASKS for s in self.signature.inputs):
            masks = b.stored_name(self._input("action_masks", (FREE, 1, 1, width)))
            forbidden = b.scale(b.shift(masks, -1, "masks/forbidden"), -FORBIDDEN, "masks/scores")
            row = b.layer_value(b.two(LayerType.ADD, b.stored_name(row), forbidden, "masked"), row.shape, row.axes)
        self._output(base_name(spec), row)

    def _output(self, name: str, row: Value) -> None:
        self.b.name_tensor(name, self.b.stored_name(row))
        self.outputs.append(name)

    # ------------------------------------------------------------------ the file

    def _constants(self) -> dict[str, float]:
        """What ML-Agents reads before it runs the model."""
        widths = {base_name(s): self._head_width(s) for s in self.heads}
        constants: dict[str, float] = {
            VERSION_NUMBER: API_VERSION,
            MEMORY_SIZE: sum(p.size for p in self.parts),
        }
        if self.signature.action_space == "hybrid":
            constants[CONTINUOUS_SHAPE] = widths["continuous_actions"]
            constants[DISCRETE_SHAPE] = widths["discrete_actions"]
        else:
            constants[IS_CONTINUOUS] = float(self.signature.action_space == "continuous")
            constants[ACTION_SHAPE] = widths[base_name(self.heads[0])]
        return constants

    def _head_width(self, spec: TensorSpec) -> int:
        draft = next(d for d in self.b.drafts if d.name == base_name(spec))
        return self.b.dims_of(draft.inputs[0])[C]

    def _assemble(self) -> NnModel:
        constants = {n: np.array([number], np.float32) for n, number in self._constants().items()}
        memories = [NnMemory((1, 1, 1, p.size), p.taken, p.given) for p in self.parts]
        return assemble(self.b, self.inputs, self.outputs, constants, memories)


def _scores_behind(graph: Graph, reference: str, b: NnBuilder) -> list[str]:
    """The scores that an action is the ArgMax of, branch by branch.

    Raises UnsupportedOpError where it is computed some other way.
    """
    node = graph.producer(reference)
    if passes_on(node) or node.op == "Cast":
        return _scores_behind(graph, node.inputs[0], b)
    if traits(node).moves == "join":
        return [
            scores for branch in traits(node).data_operands(node.inputs) for scores in _scores_behind(graph, branch, b)
        ]
    if node.op == "ArgMax" and len(b.type_of(node.inputs[0]).shape or ()) == 2:
        return [node.inputs[0]]
    b.node = node
    raise b.nn_error(
        "the action is a class, and is not the largest of some scores",
        "ML-Agents of these years takes a score for every class and chooses by itself",
    )


#: Where the axes of an input lie; the others are rows of numbers, along C.
_AXES: dict[Role, Axes] = {Role.VISUAL: (N, C, H, W), Role.ENTITIES: (N, C, W), Role.MEMORY_IN: (N, None, W)}


#: How a memory [N, 1, M, 1] becomes a row [N, 1, 1, M], and back. Barracuda 1.4.0 and 2.0.0 leave a Flatten of it as it
#: is, so that what reads it throws (../shared/unity/r3/cases/recurrent_nn_barracuda-1.4); a Transpose of W and C is
#: right in 1.4.0 to 3.0.0 (../shared/unity/onnx_rules, Squeeze_01 and Unsqueeze_01, which are imported as that layer).
_SWAP_W_AND_C = (N, H, C, W)


def dressed_model(policy: Policy) -> NnModel:
    """A policy in the names of API version 3 (ML-Agents from release 17 on), which Barracuda 1.4 to 3.0 load.

    What it takes and gives is what its ONNX does (``converters/consumers/mlagents/version3.py``), laid out as that ONNX
    is after its import: images [N, H, W, C], buffers [N, 1, W, C] with the graph's [B, C, W], ``recurrent_in`` and
    ``recurrent_out`` [N, 1, M, 1], which ML-Agents feeds and reads along W; it keeps the memory itself, so that the
    file has no memories of its own (``RecurrentInputGenerator``, ``TensorProxy.ResizeTensor`` of 2.0 to 2.3). Raises
    UnsupportedOpError.
    """
    signature, constants = policy.signature, policy.constants
    graph = prepare(policy, BARRACUDA)
    names = [s.name for s in (*signature.inputs, *signature.outputs)]
    b = NnBuilder(infer_types(graph), [*names, *constants], draws=True)
    inputs = [NnInput(s.name, _as_fed(s).dims) for s in signature.inputs]
    given = {node_of(policy.feeds[s.name]): _input(b, s) for s in signature.inputs}
    values = lower_graph(b, graph, given, policy.fetches.values())
    for spec in signature.outputs:
        b.node = Node(spec.name, "Identity")
        row = as_row(b, values[policy.fetches[spec.name]])
        name = b.stored_name(row)
        if spec.role is Role.MEMORY_OUT:
            name = b.layer(LayerType.TRANSPOSE, [name], (FREE, 1, row.size, 1), pool=_SWAP_W_AND_C, label="rows")
        b.name_tensor(spec.name, name)
    return assemble(b, inputs, [s.name for s in signature.outputs], constants)


def _as_fed(spec: TensorSpec) -> Value:
    """An input as it lies in the file."""
    shape: tuple[Dim, ...] = (BATCH, *(d or 0 for d in spec.shape[1:]))
    role = Role.ENTITIES if spec.is_sequence else spec.role
    return Value(shape, _AXES.get(role, (N, C)))


def _input(b: NnBuilder, spec: TensorSpec) -> Value:
    """An input as the graph takes it: a memory along C, where it is cut as it was before there was a W."""
    value = _as_fed(spec)
    b.note_input(spec.name, value.dims)
    if spec.role is not Role.MEMORY_IN:
        return b.layer_value(spec.name, value.shape, value.axes)
    b.node = Node(spec.name, "Placeholder")
    flat = b.layer(LayerType.TRANSPOSE, [spec.name], (FREE, 1, 1, value.size), pool=_SWAP_W_AND_C, label="row")
    return b.layer_value(flat, value.shape, (N, None, C))
