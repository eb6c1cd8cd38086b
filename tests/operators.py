"""``python -m tests.operators``: what each op of the table becomes in each target, in docs/support-tables.md.

No entry's lowering is read: the samples of an op (tests/graph/samples) are compiled and written, each for each target.
What stands in the file for it is counted, or the refusal is taken, which names the op.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import replace as again

import numpy as np
import onnx

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.compiler.targets import PROGRAM, prepare
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.litert.flatbuffer import decode
from export_model.converters.formats.litert.schema import OPERATOR_NAMES
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph import ops as families
from export_model.converters.graph import program as loops
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.approximations import APPROXIMATIONS
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, LayerType
from export_model.converters.graph.ops.base import written_as_older
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import FLOAT32
from export_model.converters.policy.policy import Policy
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import UnsupportedOpError
from tests.barracuda.nn_running import action_model, as_policy
from tests.graph.harness import policy_of, program_of
from tests.graph.samples import SAMPLES, Sample
from tests.support_tables import table, write

TITLE = "Operations and targets"
ONE, SEVERAL, REFUSED = "●", "◐", "○"
#: Beside the symbol: some samples take several ops where others take one; some are refused.
SOME_SEVERAL, SOME_REFUSED = "+", "−"
_PRECISIONS = {"rounded": "∘", "summed": "∑", "approximate": "≈"}
_OPTIONS = WriteOptions('{"tool": {"version": "test"}}')

#: Moves and casts, which stand around an operator where axes lie otherwise or a number is narrower: not counted where
#: another operator is.
_EDGES = frozenset(
    (
        *("Identity", "Const", "Placeholder", "Cast", "Reshape", "Transpose", "Squeeze", "Unsqueeze", "ExpandDims"),
        *("CAST", "RESHAPE", "TRANSPOSE", "SQUEEZE", "EXPAND_DIMS", "NOP", "LOAD", "FLATTEN"),
    )
)


@dataclass(frozen=True)
class Outcome:
    """What a target made of a sample: the operators of a result, or the refusal, by nodes and ops, with its reason."""

    operators: Sequence[str] = ()
    results: int = 1
    refused: tuple[tuple[str, str], ...] | None = None
    #: Whether the operators are the op's alone.
    counts: bool = True

    @property
    def state(self) -> str:
        """One of the three symbols."""
        if self.refused is not None:
            return REFUSED
        return ONE if sum(o not in _EDGES for o in self.operators) <= self.results else SEVERAL


def compiled(sample: Sample) -> Sample:
    """A sample whose graph is as the compiler leaves it to the writers."""
    graph = fold(normalise(sample.graph, sample.fetches)).prune(sample.fetches)
    return again(sample, nodes=graph.nodes, feeds={name: a for name, a in sample.feeds.items() if name in graph})


def samples_of(op: str) -> Iterator[tuple[Sample, bool]]:
    """Each sample of an op, compiled, and whether the op alone computes in it."""
    for sample in (s for s in SAMPLES if s.op == op):
        yield compiled(sample), all(n.name == "op" or TABLE[n.op].start for n in sample.nodes)


# ------------------------------------------------------------------ what stands in a file


def _written(key: str, sample: Sample, path: str = "") -> bytes:
    artifact = WRITTEN[key].artifact(policy_of(sample.graph, sample.fetches), _OPTIONS)
    return artifact.files[path or artifact.main].to_bytes()


#: Op → the ops of its ``.bytes`` that its SavedModel has others for, which the official converter for TensorFlow.js
#: does not break, and those (converters/compiler/passes/lowering.py).
IN_SAVED_MODEL: Mapping[str, tuple[frozenset[str], frozenset[str]]] = {
    "Softsign": (frozenset({"Softsign"}), frozenset({"Abs", "Add", "Const", "RealDiv"})),
    "Cast": (frozenset({"Cast"}), frozenset({"NotEqual", "Const"})),
    "SelectV2": (frozenset({"Cast"}), frozenset({"NotEqual", "Const"})),
    "Conv2D": (frozenset(), frozenset({"Pad", "StridedSlice", "Const"})),
    "DepthwiseConv2dNative": (frozenset(), frozenset({"Pad", "Const"})),
    "StridedSlice": (frozenset(), frozenset({"Squeeze"})),
    "OneHot": (
        frozenset({"OneHot", "Const"}),
        frozenset({"Equal", "Cast", "ExpandDims", "Const", "Add", "Mul", "Sub", "Transpose"}),
    ),
}


def tensorflow_ops(sample: Sample) -> tuple[Counter[str], Counter[str]]:
    """The ops of the ``.bytes``, and those of the SavedModel."""
    saved = schema.SavedModel.FromString(_written("saved_model", sample, "saved_model/saved_model.pb"))
    frozen = schema.GraphDef.FromString(_written("bytes", sample))
    return Counter(n.op for n in frozen.node), Counter(n.op for n in saved.meta_graphs[0].graph_def.node)


def _tensorflow(sample: Sample) -> list[str]:
    frozen, saved = tensorflow_ops(sample)
    less, more = IN_SAVED_MODEL.get(sample.op, (frozenset(), frozenset()))
    assert (frozen - saved).keys() <= less, (sample.op, frozen - saved)
    assert (saved - frozen).keys() <= more, (sample.op, saved - frozen)
    return list(frozen.elements())


def _tfjs(sample: Sample) -> list[str]:
    model = json.loads(_written("tfjs", sample, "tfjs/model.json"))
    return [n["op"] for n in model["modelTopology"]["node"]]


def _onnx(sample: Sample) -> list[str]:
    return [n.op_type for n in onnx.ModelProto.FromString(_written("onnx", sample)).graph.node]


def _litert(sample: Sample) -> list[str]:
    model = decode(_written("litert", sample))
    codes = [OPERATOR_NAMES[c.get("builtin_code", 0)] for c in model["operator_codes"]]
    return [codes[o.get("opcode_index", 0)] for o in model["subgraphs"][0].get("operators", ())]


def _nn(sample: Sample) -> list[str] | None:
    """None where nothing is said: ML-Agents has nothing to feed the sample with."""
    policy = as_policy(sample)
    if policy is not None:
        return _layers(policy)
    beside, alone = (as_policy(s) for s in _beside_an_observation(sample))
    if beside is None or alone is None:
        return None
    return list((Counter(_layers(beside)) - Counter(_layers(alone))).elements())


def _layers(policy: Policy) -> list[str]:
    """The layers; one that passes on what it is given is an activation without a function."""
    return [
        "NOP"
        if layer.type == LayerType.ACTIVATION and layer.activation == Activation.NONE
        else LayerType(layer.type).name
        for layer in action_model(policy).layers
    ]


def _beside_an_observation(sample: Sample) -> Iterator[Sample]:
    """The sample's result, of no agent, added to an observation; and a constant in its place."""
    value = run_graph(sample.graph, sample.feeds, ["op"])["op"]
    agents = next((len(a) for a in sample.feeds.values() if a.ndim), 2)
    seen = np.zeros((agents, max(value.size, 1)), np.float32)
    fed = Node("seen", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, seen.shape[1]))})
    row = [
        Node("one", "Const", value=np.array([1, value.size], np.int32)),
        Node("row", "Reshape", ("op", "one")),
        Node("number", "Cast", ("row",), {"DstT": FLOAT32}),
        Node("sum", "Add", ("seen", "number")),
    ]
    for nodes in (sample.nodes, (Node("op", "Const", value=value),)):
        made = again(sample, nodes=(fed, *nodes, *row), feeds={"seen": seen, **sample.feeds})
        yield _Ended(**vars(made))


class _Ended(Sample):
    """A sample with nodes behind its op."""

    @property
    def fetches(self) -> list[str]:
        return ["sum"]


def _program(sample: Sample) -> list[str] | None:
    """None where nothing is said: no contract has an output of no numbers. One without axes is given one."""
    results = run_graph(sample.graph, sample.feeds, sample.fetches)
    if not all(a.size for a in results.values()):
        return None
    graph, fetches = sample.with_shapes(lambda _, array: TensorShape(array.shape)), sample.fetches
    if not all(a.ndim for a in results.values()):
        axis = (Node("axis", "Const", value=np.array([1], np.int32)), Node("row", "Reshape", ("op", "axis")))
        graph, fetches = Graph((*graph.nodes, *axis)), ["row"]
    policy = policy_of(graph, fetches)
    program = loops.program_of(prepare(policy, PROGRAM), policy.feeds, policy.fetches)
    for key in (key for key, form in WRITTEN.items() if form.program):
        assert program_of(key, policy, CodeOptions()).files
    return ["loop"] * len(program.stages)


#: The columns: their titles, and what gives the operators that a sample became there.
WRITERS: Mapping[str, Callable[[Sample], Sequence[str] | None]] = {
    "TensorFlow": _tensorflow,
    "TensorFlow.js": _tfjs,
    "ONNX": _onnx,
    "`.nn`": _nn,
    "LiteRT": _litert,
    "code": _program,
}


def outcomes(op: str, title: str) -> Iterator[Outcome]:
    """What the target of a column makes of each sample of an op that says something there."""
    for sample, alone in samples_of(op):
        try:
            operators = WRITERS[title](sample)
        except UnsupportedOpError as error:
            if any(name in sample.graph for name, _ in error.issues) or not error.issues:
                yield Outcome(refused=tuple(error.issues))
        else:
            if operators is not None:
                yield Outcome(operators, sample.outputs, counts=alone)


def cell(found: Iterable[Outcome]) -> str:
    """One of the three symbols, with marks where samples of the op differ; empty where none says anything."""
    found = list(found)
    written = [o for o in found if o.refused is None]
    if not written:
        return REFUSED if found else ""
    states = {o.state for o in written if o.counts} or {o.state for o in written}
    text = ONE if ONE in states else SEVERAL
    return text + SOME_SEVERAL * (len(states) > 1) + SOME_REFUSED * (len(written) < len(found))


# ------------------------------------------------------------------ the page

#: What is left of a policy's ops when a target is asked, by the file of its entry; and what is written as these before.
FAMILIES: Mapping[str, Sequence[str]] = {
    name: found
    for name in sorted(m.name for m in pkgutil.iter_modules(families.__path__))
    for module in [importlib.import_module(f"{families.__name__}.{name}")]
    if (found := [o.name for o in getattr(module, "OPS", ()) if o.infer is not written_as_older])
}
OPS = [op for found in FAMILIES.values() for op in found]
OLDER = [name for name, entry in TABLE.items() if entry.infer is written_as_older]

HEAD = f"""\
## {TITLE}

What each operation becomes, found by writing its samples, which the tests compare in all runtimes. One operator of the
target, or none (a constant, another view; casts and moved axes do not count), unless its row says: {SEVERAL} several,
`{SOME_SEVERAL}` some forms take several, `{SOME_REFUSED}` some are refused, {REFUSED} refused by name.

*TensorFlow*: `.bytes`; the SavedModel differs in forms of {", ".join(f"`{op}`" for op in IN_SAVED_MODEL)}, \
for `tensorflowjs_converter`. *Code*: C, C# and JavaScript, in nests of loops. Behind a name: \
{_PRECISIONS["rounded"]} rounds once, {_PRECISIONS["summed"]} sums in any order, {_PRECISIONS["approximate"]} is \
approximated (below); the others never round. `_Fused…` are made of layers, for targets that have them.
"""
BOUNDS = """\
### Approximated functions

How far results are off at most: units in the last place/absolute, whichever is more. Measured by
`tests/runtimes/test_approximations.py` in TensorFlow (1.4 too), onnxruntime, TensorFlow.js; in brackets where others
differ: *graphics* (WebGL), *phone* (LiteRT), *compiled* (OpenVINO).
"""


def writer_cells(op: str) -> list[str]:
    """What each target makes of an op."""
    return [cell(outcomes(op, title)) for title in WRITERS]


def differences(op: str) -> str:
    """The targets that have more or less than one operator for an op."""
    cells = zip(WRITERS, writer_cells(op), strict=True)
    return ", ".join(f"{title} {found.removeprefix(ONE)}" for title, found in cells if found != ONE)


def named(op: str) -> str:
    """An op's name, with a mark where it rounds."""
    entry = TABLE[op]
    return f"`{op}`" + ("" if entry.exact or entry.precision == "exact" else _PRECISIONS[entry.precision])


def page() -> str:
    """Return the part of the page in Markdown."""
    return "\n".join((HEAD, *_matrix(), "", BOUNDS, *_bounds())) + "\n\n"


def _matrix() -> Iterator[str]:
    """Yield a line for all ops that the targets treat alike, in the order of the first."""
    alike: dict[str, list[str]] = {}
    for op in OPS:
        alike.setdefault(differences(op), []).append(named(op))
    rows = ((", ".join(ops), where or "one operator everywhere") for where, ops in alike.items())
    yield from table(("operations", "where not one operator"), rows)
    yield f"Written as these first: {', '.join(f'`{op}`' for op in OLDER)}."


def _bounds() -> Iterator[str]:
    usual, *_ = APPROXIMATIONS.values()
    others = dict(list(APPROXIMATIONS.items())[1:])
    rows = []
    for op, bound in usual.items():
        apart = [f"{name} {_bound(of[op])}" for name, of in others.items() if of[op] != bound]
        rows.append(f"`{op}` {_bound(bound)}" + (f" ({', '.join(apart)})" if apart else ""))
    yield f"{'; '.join(rows)}."
    yield ""
    unmeasured = [o for o in OPS if TABLE[o].precision == "approximate" and o not in usual]
    yield f"Not measured: {', '.join(f'`{op}`' for op in unmeasured)}."


def _bound(bound: tuple[float, float]) -> str:
    return "/".join(f"{number:g}" for number in bound if number)


if __name__ == "__main__":
    write(TITLE, page())
