"""Functions written out where they are called: the flat graph of a SavedModel of TensorFlow 2 (function.proto).

A function's nodes read its arguments by name (``x``) and one another's results by the op's own names for them
(``split:output:1``). Each call becomes a copy of the nodes that its results need, called ``<call>/<node>`` (those that
a signature calls keep their names); ``While`` and ``If`` become the Switch and Merge of TensorFlow 1. Nothing is run
for it, and a function that does more than compute is refused wherever in it that hangs: TensorFlow runs all of a
function that has effects, whether its result needs them or not.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.subgraph import COMPUTING, is_pivot
from export_model.converters.graph.nodes import NameScope, Node, normal_ref, reachable, ref, renamed_ref, split_ref
from export_model.converters.graph.ops.table import (
    CALLING,
    EFFECTS,
    IFS,
    ORDERING,
    READS,
    RESULTS,
    WHILES,
    unsupported_error,
)
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

_ALLOWED = COMPUTING | READS | ORDERING | CALLING
_BOOL = 10  # DataType
#: Copies of a graph's functions may hold this many nodes, and bytes: a small file could unfold to any size otherwise.
MAX_INLINED_NODES = 1 << 15
_BYTES_FREE, _BYTES_FACTOR = 1 << 26, 4
#: What a tensor that is handed to a function or back is charged.
_PASSED = 1 << 8
_MAX_DEPTH = 64


class Flat:
    """A graph without calls: ``definition`` is its GraphDef, ``tensor`` gives the name of what the caller named."""

    def __init__(self, definition: Any, places: Mapping[str, str]) -> None:
        self.definition = definition
        self._places = places

    def tensor(self, reference: str) -> str:
        """What a tensor of the original graph is called here."""
        name, index = split_ref(reference)
        return self._places.get(ref(name, index), ref(name, index))


def flat(
    graph_def: Any, roots: Iterable[str], names: Mapping[str, str] | None = None, *, restoring: bool = False
) -> Flat:
    """What the tensors ``roots`` depend on, its functions inlined; ``names`` are other names for nodes.

    Raises UnsupportedOpError where an op does more than compute, unless ``restoring`` (the result is then only read:
    which variable is restored from what); DamagedFileError, NotAPolicyError.
    """
    return _Flattening(graph_def, names or {}, restoring=restoring).run(list(roots))


class _Function:
    """What belongs to a function alone, however often it is called: the nodes that its results need."""

    def __init__(self, definition: Any) -> None:
        self.arguments = [a.name for a in definition.signature.input_arg]
        self.results = [a.name for a in definition.signature.output_arg]
        self.made_of = dict(definition.ret)
        self.own = {n.name: n for n in definition.node_def}
        wanted = [r.partition(":")[0] for r in self.made_of.values()] + list(definition.control_ret.values())
        given = set(self.arguments)
        self.nodes = _upstream(self.own, [w for w in wanted if w not in given], given)
        self.letters = sum(len(n.name) for n in self.nodes)


class _Flattening:
    def __init__(self, graph_def: Any, names: Mapping[str, str], *, restoring: bool) -> None:
        self.graph_def = graph_def
        self.functions = {f.signature.name: f for f in graph_def.library.function}
        self.known: dict[str, _Function] = {}
        self.restoring = restoring
        self.scope = NameScope(n.name for n in graph_def.node if not self._calls(n))
        self.names = {old: self.scope.fresh(new) for old, new in names.items() if old != new}
        self.result = schema.GraphDef()
        self.result.versions.CopyFrom(graph_def.versions)
        #: a call's result → the tensor that it is
        self.aliases: dict[str, str] = {}
        self.places_left = MAX_INLINED_NODES
        self.bytes_left = _BYTES_FREE + _BYTES_FACTOR * int(graph_def.ByteSize())

    def run(self, roots: Sequence[str]) -> Flat:
        nodes = _upstream({n.name: n for n in self.graph_def.node}, roots)
        # The functions of a signature have nodes called as the call is: its results are told apart by a NUL.
        placed = {n.name: self.names.get(n.name, f"\0{n.name}" if self._calls(n) else n.name) for n in nodes}

        def tensor(reference: str) -> str:
            return renamed_ref(reference, placed)

        self._check(nodes)
        pinned = {n.name for n in nodes if is_pivot(n)}
        for node in nodes:
            self._place(node, placed[node.name], [tensor(i) for i in node.input if not i.startswith("^")], "", 0)
            if not self._calls(node):  # which frame of a while loop of TensorFlow 1 it is in
                controls = [i[1:] for i in node.input if i.startswith("^") and i[1:] in pinned]
                self.result.node[-1].input.extend(f"^{placed[c]}" for c in controls)
        for node in self.result.node:
            for i, reference in enumerate(node.input):
                if not reference.startswith("^"):
                    node.input[i] = self._resolve(reference)
        outer = {r: tensor(r) for r in [*self.aliases, *map(normal_ref, roots), *placed]}
        return Flat(self.result, {r: self._resolve(t) for r, t in outer.items()})

    def _calls(self, node: Any) -> bool:
        return node.op in CALLING or node.op in self.functions

    def _check(self, nodes: Iterable[Any]) -> None:
        refused = [n for n in nodes if n.op not in _ALLOWED and n.op not in self.functions]
        if refused and not self.restoring:
            if changed := next((n for n in refused if n.op.startswith(EFFECTS)), None):
                raise NotAPolicyError(
                    f"the SavedModel writes to a variable whenever it is called (node {changed.name!r}, {changed.op})",
                    why="it keeps a memory in itself, which a frozen graph does not have",
                    fix="save it with the memory as an input and an output; or without what counts or learns",
                )
            raise unsupported_error(Node(n.name, n.op) for n in refused)

    def _resolve(self, reference: str) -> str:
        """The tensor behind the results of calls, which is noted for all that were passed on the way."""
        passed: dict[str, None] = {}
        while reference in self.aliases:
            if reference in passed:
                raise _damaged_error(f"the call's result {reference!r} is made of itself")
            passed[reference] = None
            reference = self.aliases[reference]
        self.aliases.update(dict.fromkeys(passed, reference))
        return reference

    # ---- nodes

    def _place(self, node: Any, name: str, inputs: Sequence[str], pivot: str, depth: int) -> None:
        """A node, or in place of a call what it calls. ``pivot`` pins what has no inputs to the frame of a loop."""
        if not self._calls(node):
            copy = schema.NodeDef(name=name, op=node.op)
            copy.input.extend(inputs)
            if pivot and not inputs:
                copy.input.append(f"^{pivot}")
            for key, value in node.attr.items():
                if value.WhichOneof("value") == "placeholder":
                    raise NotAPolicyError(
                        f"the function's node {node.name!r} takes its attribute {key!r} from the caller",
                        why="functions of TensorFlow 2 are of one type each; this one was written by another tool",
                        fix="save the model again (tf.saved_model.save), or freeze it to a GraphDef",
                    )
                copy.attr[key].CopyFrom(value)
            self._add(copy)
        elif node.op in WHILES:
            self._loop(node, name, inputs, depth)
        elif node.op in IFS:
            self._branch(node, name, inputs, depth)
        else:
            called = node.op if node.op in self.functions else node.attr["f"].func.name
            results = self._body(called, name if depth else "", inputs, pivot, depth)
            self._count(len(name) * len(results), 0)
            for index, result in enumerate(results):
                self.aliases[ref(name, index)] = result

    def _add(self, node: Any) -> None:
        self._count(node.ByteSize())
        self.result.node.append(node)

    def _count(self, size: int, places: int = 1) -> None:
        """Count a node or a call; raises NotAPolicyError when that is too much."""
        self.places_left -= places
        self.bytes_left -= size
        if self.places_left < 0 or self.bytes_left < 0:
            raise NotAPolicyError(
                "the SavedModel's functions unfold to more nodes or constants than a policy has",
                why=f"more than {MAX_INLINED_NODES} nodes, or more than {_BYTES_FACTOR} times the size of the graph",
                fix="save the policy alone, without the training part",
            )

    # ---- functions

    def _body(self, called: str, prefix: str, arguments: Sequence[str], pivot: str, depth: int) -> list[str]:
        """The results of a function, its nodes placed."""
        function = self._function(called)
        passed = len(function.arguments) + len(function.results)
        self._count(_PASSED * passed + len(prefix) * len(function.nodes) + function.letters)
        if depth >= _MAX_DEPTH:
            raise _damaged_error(f"the function {called!r} is called {depth} functions deep, or calls itself")
        if len(arguments) != len(function.arguments):
            taken = len(function.arguments)
            raise _damaged_error(f"the function {called!r} takes {taken} tensors and is given {len(arguments)}")
        given = dict(zip(function.arguments, arguments, strict=True))
        placed = {n.name: self.scope.fresh(f"{prefix}/{n.name}" if prefix else n.name) for n in function.nodes}

        def tensor(reference: str) -> str:
            name, _, rest = reference.partition(":")
            if name in given:
                return str(given[name])
            if name not in placed:
                raise _damaged_error(f"a node of the function {called!r} reads {reference!r}, which is not there")
            result, _, position = rest.rpartition(":")
            return ref(placed[name], _index(function.own[name].op, result, position))

        for node in function.nodes:
            inputs = [tensor(i) for i in node.input if not i.startswith("^")]
            self._place(node, placed[node.name], inputs, pivot, depth + 1)
        results = []
        for result in function.results:
            if result not in function.made_of:
                raise _damaged_error(f"the function {called!r} does not say what its result {result!r} is")
            results.append(tensor(function.made_of[result]))
        return results

    def _function(self, called: str) -> _Function:
        if called not in self.known:
            if called not in self.functions:
                raise _damaged_error(f"the function {called!r} is called and is not there")
            function = _Function(self.functions[called])
            self._check(function.nodes)
            self.known[called] = function
        return self.known[called]

    def _loop(self, node: Any, name: str, inputs: Sequence[str], depth: int) -> None:
        """``While`` as TensorFlow 1 writes it: Enter, Merge, LoopCond, Switch, NextIteration, Exit."""
        base = name.removeprefix("\0")
        types = list(node.attr["T"].list.type)
        if len(types) != len(inputs) or not inputs:
            raise _damaged_error(f"the loop {node.name!r} says {len(types)} types for {len(inputs)} variables")

        merges = []
        for source, dtype in zip(inputs, types, strict=True):
            enter = self._part(base, "Enter", source, T=dtype)
            enter.attr["frame_name"].s = base.encode()
            enter.attr["is_constant"].b = False
            enter.attr["parallel_iterations"].i = 1
            self._add(enter)
            merge = self._part(base, "Merge", enter.name, T=dtype)
            merge.attr["N"].i = 2
            merges.append(merge)
        heads = [m.name for m in merges]
        condition = self._one(node.attr["cond"].func.name, f"{base}/cond", heads, heads[0], depth)
        decided = self._part(base, "LoopCond", condition)
        self._add(decided)
        switches = [self._part(base, "Switch", h, decided.name, T=t) for h, t in zip(heads, types, strict=True)]
        turns = [self._part(base, "Identity", ref(s.name, 1), T=t) for s, t in zip(switches, types, strict=True)]
        for made in (*switches, *turns):
            self._add(made)
        carried = self._body(node.attr["body"].func.name, f"{base}/body", [t.name for t in turns], turns[0].name, depth)
        if len(carried) != len(inputs):
            raise _damaged_error(f"the body of the loop {node.name!r} gives {len(carried)} of {len(inputs)} variables")
        for index, (merge, switch, result, dtype) in enumerate(zip(merges, switches, carried, types, strict=True)):
            following = self._part(base, "NextIteration", result, T=dtype)
            merge.input.append(following.name)
            leaving = self._part(base, "Exit", switch.name, T=dtype)
            for made in (following, merge, leaving):
                self._add(made)
            self.aliases[ref(name, index)] = leaving.name

    def _branch(self, node: Any, name: str, inputs: Sequence[str], depth: int) -> None:
        """``If`` as TensorFlow 1 writes it: Switch before both sides, Merge behind them."""
        base = name.removeprefix("\0")
        types = [node.attr["Tcond"].type, *node.attr["Tin"].list.type]
        if len(types) != len(inputs) or types[0] != _BOOL:
            raise _damaged_error(f"the branch {node.name!r} takes no bool, or other inputs than it says")
        switches = [self._part(base, "Switch", s, inputs[0], T=t) for s, t in zip(inputs, types, strict=True)]
        for made in switches:
            self._add(made)
        sides = []
        for index, key in ((0, "else_branch"), (1, "then_branch")):
            pivot = schema.node_def(
                self.scope.fresh(f"{base}/pivot"), "Identity", [ref(switches[0].name, index)], T=_BOOL
            )
            self._add(pivot)
            given = [ref(s.name, index) for s in switches[1:]]
            sides.append(self._body(node.attr[key].func.name, f"{base}/{key}", given, pivot.name, depth))
        results = list(node.attr["Tout"].list.type)
        if not len(sides[0]) == len(sides[1]) == len(results):
            raise _damaged_error(f"the two sides of the branch {node.name!r} give different numbers of results")
        for index, (no, yes, dtype) in enumerate(zip(*sides, results, strict=True)):
            made = self._part(base, "Merge", no, yes, T=dtype)
            made.attr["N"].i = 2
            self._add(made)
            self.aliases[ref(name, index)] = made.name

    def _part(self, base: str, op: str, *sources: str, **types: int) -> Any:
        """A node of a loop or branch, called after its op."""
        return schema.node_def(self.scope.fresh(f"{base}/{op}"), op, sources, **types)

    def _one(self, called: str, prefix: str, arguments: Sequence[str], pivot: str, depth: int) -> str:
        results = self._body(called, prefix, arguments, pivot, depth)
        if len(results) != 1:
            raise _damaged_error(f"the function {called!r} has {len(results)} results where a loop wants one")
        return results[0]


def _index(op: str, result: str, position: str) -> int:
    """The number of an output of an op, of ``<name of the result>:<position in it>``."""
    if not position.isascii() or not position.isdigit() or len(position) > 9:
        return 0
    named = RESULTS.get(op, ())
    return int(position) + (named.index(result) if result in named else 0)


def _upstream(nodes: Mapping[str, Any], roots: Iterable[str], given: Collection[str] = ()) -> list[Any]:
    """The nodes that ``roots`` depend on, control inputs counted, in the order of ``nodes``."""

    def inputs(name: str) -> Iterable[str]:
        if name in given:
            return ()
        if name not in nodes:
            raise _damaged_error(f"{name!r} is read and is not in the graph")
        return (i.removeprefix("^").partition(":")[0] for i in nodes[name].input)

    seen = reachable((r.removeprefix("^").partition(":")[0] for r in roots), inputs)
    return [n for n in nodes.values() if n.name in seen and n.name not in given]


def _damaged_error(what: str) -> DamagedFileError:
    return DamagedFileError(what, why="the SavedModel's functions do not fit together", fix="save the model again")
