"""The op table: every op the compiler knows, by its TensorFlow name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops import (
    activations,
    arrays,
    blocks,
    convolution,
    elementwise,
    filling,
    joining,
    linear,
    logic,
    older,
    places,
    reductions,
    samplers,
    slicing,
    transposed,
)
from export_model.converters.graph.ops.base import OpDef, written_as_older
from export_model.signatures.errors import UnsupportedOpError

#: While loops, conditionals and tensor arrays, by what they do: the unroll pass removes them, so they have no entry.
CONTROL_FLOW: Mapping[str, str] = {
    **{f"{ref}{op}": op.lower() for ref in ("", "Ref") for op in ("Enter", "Exit", "Merge", "Switch")},
    **dict.fromkeys(("NextIteration", "RefNextIteration"), "next_iteration"),
    "LoopCond": "loop_cond",
    "TensorArrayV3": "array",
    **{f"TensorArray{op}V3": op.lower() for op in ("Scatter", "Gather", "Read", "Write", "Size")},
    **{f"TensorList{op}": f"list_{op.lower()}" for op in ("FromTensor", "Reserve", "GetItem", "SetItem", "Stack")},
    "TensorListLength": "list_length",
}

#: Ops that take references to variables, which frozen graphs do not have → those that take values.
OF_VALUES: Mapping[str, str] = {
    f"Ref{op}": op for op in ("Enter", "Exit", "Merge", "Switch", "NextIteration", "Identity")
}

#: Ops with several results of different names, in their order (the registry of TensorFlow 2.21).
RESULTS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(
        ("FusedBatchNorm", "FusedBatchNormV2", "FusedBatchNormV3"),
        ("y", "batch_mean", "batch_variance", "reserve_space_1", "reserve_space_2", "reserve_space_3"),
    ),
    "Switch": ("output_false", "output_true"),
    "Merge": ("output", "value_index"),
    "TensorArrayV3": ("handle", "flow"),
}

#: Ops that reach outside the graph. A model file is untrusted input: these are refused by name.
FORBIDDEN = frozenset(
    (
        *("ReadFile", "WriteFile", "MatchingFiles", "SaveV2", "RestoreV2", "Save", "Restore", "LoadLibrary"),
        *("PyFunc", "PyFuncStateless", "EagerPyFunc", "RemoteCall", "SymbolicGradient"),
        *("ReaderReadV2", "WholeFileReaderV2", "TextLineReaderV2", "Print", "PrintV2", "Assert", "DebugIdentity"),
    )
)

#: Ops of other projects → (why they are not converted, what to do).
_REMEDIES: Mapping[str, tuple[str, str]] = {
    "XlaCallModule": (
        "JAX (jax2tf) wrote the network as StableHLO inside of one op, which XLA alone runs",
        "export it from JAX with jax2onnx (pip install jax2onnx), and give the .onnx",
    ),
}

# Ops that have no entry, because none is left when the compiler begins: readers replace them (a variable by its value,
# a call by what the function computes) or leave them out. TensorFlow's names, 1.0 to 2.21.

#: Ops that keep a value in a checkpoint.
VARIABLES = frozenset(("VariableV2", "Variable", "VarHandleOp", "AutoReloadVariable"))
#: Ops that give a variable a value, and those that take it from a checkpoint.
ASSIGNS = frozenset(("Assign", "AssignVariableOp"))
RESTORES = frozenset(("RestoreV2", "Restore", "RestoreSlice"))
#: How the names of ops begin that only training runs: they change or keep variables.
EFFECTS = ("Assign", "Apply", "ResourceApply", "SparseApply", "Scatter", "ResourceScatter", "Save", "Restore")
#: What a variable of TensorFlow 2 is read by, the variable itself among them.
READS = frozenset(("VarHandleOp", "ReadVariableOp", "ResourceGather", "VariableShape"))
#: Ops that may hang behind a control input, where they are left out: they compute nothing that anyone reads.
ORDERING = frozenset(("NoOp", "Assert"))
#: Ops that call the function which their attribute ``f`` names; loops and branches whose bodies are functions.
CALLS = frozenset(("PartitionedCall", "StatefulPartitionedCall", "TPUPartitionedCall"))
WHILES = frozenset(("While", "StatelessWhile"))
IFS = frozenset(("If", "StatelessIf"))
CASES = frozenset(("Case", "StatelessCase"))
#: Every op that calls functions, and those of them that are written out.
FUNCTIONAL = CALLS | WHILES | IFS | CASES
CALLING = CALLS | WHILES | IFS


def _table() -> Mapping[str, OpDef]:
    table: dict[str, OpDef] = {}
    numbers = (elementwise, activations, logic, linear, convolution, reductions, samplers)
    for module in (*numbers, arrays, joining, slicing, filling, places, older, blocks, transposed):
        for op in module.OPS:
            if op.name in table:
                raise ValueError(f"op {op.name} is in the table twice")
            table[op.name] = op
    return table


TABLE = _table()
#: Other names of an op → the op's.
SPELLINGS: Mapping[str, str] = {name: op.name for op in TABLE.values() for name in op.spellings}
_UNKNOWN = OpDef("", written_as_older)
#: Both in one, plain: they are asked for every node in every pass.
_BY_NAME = dict(TABLE)
_BY_SPELLING = {**TABLE, **{name: TABLE[op] for name, op in SPELLINGS.items()}}


class Operation(Protocol):
    """A Node, or a NodeDef message."""

    @property
    def op(self) -> str:
        """The op's name."""


def traits(node: Operation) -> OpDef:
    """What is known of a node's op, whichever version spells it; of an op that the table lacks, nothing."""
    return _BY_SPELLING.get(node.op, _UNKNOWN)


def is_fed(node: Operation) -> bool:
    """Whether a node is a placeholder, with a default or without."""
    return traits(node).start == "fed"


def passes_on(node: Operation) -> bool:
    """Whether a node gives its operand's elements in their order, perhaps under another shape."""
    return traits(node).moves in ("same", "view")


def hands_on(node: Operation) -> bool:
    """Whether a node gives its operand as it is, perhaps into a loop or branch, or out of one."""
    flow = CONTROL_FLOW.get(node.op)
    return traits(node).moves == "same" or flow in ("enter", "exit", "merge", "switch", "next_iteration")


def op_of(node: Node) -> OpDef:
    """The entry for a node's op; raises UnsupportedOpError."""
    entry = _BY_NAME.get(node.op)
    if entry is None:
        raise unsupported_error([node])
    return entry


def unsupported_error(nodes: Iterable[Node]) -> UnsupportedOpError:
    """The error that names every node whose op is not in the table."""
    issues = [(n.name, n.op) for n in nodes]
    shown = ", ".join(f"{op} (node {name!r})" for name, op in issues[:5])
    more = f" and {len(issues) - 5} more" if len(issues) > 5 else ""
    forbidden = [op for _, op in issues if op in FORBIDDEN]
    loops = [op for _, op in issues if op in CONTROL_FLOW]
    if forbidden:
        why = (
            f"{forbidden[0]} reaches outside the graph (files, processes, Python); such a model is not run or converted"
        )
        fix = "freeze only the policy's own outputs; the op belongs to training or to a debugging aid"
    elif remedy := next((_REMEDIES[op] for _, op in issues if op in _REMEDIES), None):
        why, fix = remedy
    elif loops:
        why = "a loop or branch is left whose number of steps or condition is not known before the graph runs"
        fix = "give the placeholder that decides it a value: --set NAME=VALUE (sequence_length is set to 1 by itself)"
    else:
        why = "this op is not supported yet"
        fix = "if the op is not part of the policy, name the outputs you need with --output; else please open an issue"
    return UnsupportedOpError(f"cannot convert {shown}{more}", issues=issues, why=why, fix=fix)
