"""The op table: every op the compiler knows, by its TensorFlow name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType

from converters.graph.nodes import Node
from converters.graph.ops import arrays, convolution, elementwise, filling, linear, slicing
from converters.graph.ops import samplers as chance
from converters.graph.ops.base import OpDef
from signatures.errors import UnsupportedOpError

#: While loops, conditionals and tensor arrays: the straighten pass removes them, so they have no entry.
CONTROL_FLOW = frozenset(
    (
        *("Enter", "Exit", "Merge", "Switch", "LoopCond", "NextIteration"),
        *("RefEnter", "RefExit", "RefMerge", "RefSwitch", "RefNextIteration"),
        *("TensorArrayV3", "TensorArrayScatterV3", "TensorArrayGatherV3"),
        *("TensorArrayReadV3", "TensorArrayWriteV3", "TensorArraySizeV3"),
    )
)

#: Ops that reach outside the graph. A model file is untrusted input: these are refused by name.
FORBIDDEN = frozenset(
    (
        *("ReadFile", "WriteFile", "MatchingFiles", "SaveV2", "RestoreV2", "Save", "Restore", "LoadLibrary"),
        *("PyFunc", "PyFuncStateless", "EagerPyFunc", "RemoteCall", "SymbolicGradient"),
        *("ReaderReadV2", "WholeFileReaderV2", "TextLineReaderV2", "Print", "PrintV2", "Assert", "DebugIdentity"),
    )
)


def _table() -> Mapping[str, OpDef]:
    table: dict[str, OpDef] = {}
    for module in (elementwise, linear, convolution, arrays, slicing, filling, chance):
        for op in module.OPS:
            if op.name in table:
                raise ValueError(f"op {op.name} stands twice in the table")
            table[op.name] = op
    return MappingProxyType(table)


TABLE = _table()


def op_of(node: Node) -> OpDef:
    """The entry for a node's op; raises UnsupportedOpError."""
    entry = TABLE.get(node.op)
    if entry is None:
        raise unsupported([node])
    return entry


def unsupported(nodes: Iterable[Node]) -> UnsupportedOpError:
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
    elif loops:
        why = "a loop or branch is left whose number of steps or condition is not known before the graph runs"
        fix = "give the placeholder that decides it a value: --set NAME=VALUE (sequence_length is set to 1 by itself)"
    else:
        why = "no kernel, shape rule and ONNX lowering stand in the op table for it"
        fix = "if the op is not part of the policy, name the outputs you need with --output; else please open an issue"
    return UnsupportedOpError(f"cannot convert {shown}{more}", issues=issues, why=why, fix=fix)
