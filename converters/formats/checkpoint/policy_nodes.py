"""What of a training graph is the policy: the trainers' own lists of nodes to freeze (docs: mlagents-contract §1.1).

A checkpoint's graph holds all of training. Outputs are told by their names at the top level, as the trainers did; three
generations need a word more:

- 0.3.0 behavioural cloning, discrete: the sampler itself was named ``action``, so the tensor is ``action/Multinomial``,
  and the trainer's own export failed ("action is not in graph"). 0.3.1 put an Identity called ``action`` behind it.
- 0.3 to 0.5 behavioural cloning exported ``action`` and ``recurrent_out`` only.
- 0.22 and later dropped ``action_probs``; the node is still there.
"""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.checkpoint.freeze import is_effect
from export_model.converters.graph.nodes import Graph, Node, node_of, topological
from export_model.converters.policy.brains import find_brains
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import OUTPUT_NAMES, TRAINER_VERSION, VERSION_NUMBER, Constant, numbers

_SAMPLED = "action/Multinomial"
_CLONED = frozenset(("action", "recurrent_out"))


def policy_nodes(graph: Graph) -> tuple[Graph, tuple[str, ...]]:
    """(the graph whose outputs are those that the trainer would have frozen, notes on what was done)."""
    graph, notes = _with_action(graph)
    try:
        brains = find_brains(graph)
    except ExportModelError:
        return _without_training(graph), notes
    hidden = [
        name
        for brain in brains
        for base, _, reference in brain.outputs
        if _is_inner(graph, brain.scope, base, brain.constants) and (name := node_of(reference))
    ]
    return graph.rename({name: f"{name}/not_exported" for name in hidden}), notes


def _with_action(graph: Graph) -> tuple[Graph, tuple[str, ...]]:
    """An Identity called ``action`` behind the samplers of 0.3.0, where nothing else is called so."""
    if any(n.name.rpartition("/")[2] in OUTPUT_NAMES for n in graph.nodes):
        return graph, ()
    samplers = [n for n in graph.nodes if n.name.endswith(_SAMPLED) and n.op == "Multinomial"]
    added = [
        Node(n.name.removesuffix("/Multinomial"), "Identity", (n.name,), origin=n.origin)
        for n in samplers
        if n.name == _SAMPLED or n.name.endswith("/" + _SAMPLED)
    ]
    if not added:
        return graph, ()
    note = "ML-Agents 0.3.0 could not export this policy itself: its action is the node action/Multinomial"
    return Graph(topological([*graph.nodes, *added])), (note,)


def _is_inner(graph: Graph, scope: str, base: str, constants: Mapping[str, Constant]) -> bool:
    """Whether the trainer that wrote the graph did not export the output ``base``."""
    if VERSION_NUMBER not in constants and scope + "teacher_action" in graph:
        return base not in _CLONED
    known = numbers(constants)
    version = tuple(known.get(name, 0) for name in TRAINER_VERSION[:2])
    return base == "action_probs" and version >= (0, 22)


def _without_training(graph: Graph) -> Graph:
    """Without what changes variables and what follows from it, so that few candidates for the action are left."""
    dropped: set[str] = set()
    for node in graph.nodes:
        gradient = any(part.startswith("gradients") for part in node.name.split("/"))
        if gradient or is_effect(node) or any(node_of(r) in dropped for r in node.inputs):
            dropped.add(node.name)
    consumers = graph.consumers()
    for node in reversed(graph.nodes):  # what only training read
        readers = consumers[node.name]
        if readers and all(r.name in dropped for r in readers):
            dropped.add(node.name)
    kept = tuple(n for n in graph.nodes if n.name not in dropped)
    return Graph(kept) if kept else graph
