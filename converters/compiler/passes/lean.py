"""A graph in fewer ops, for runtimes in which the start of an op is most of a small policy's run: TensorFlow.js, ONNX.

``.bytes`` and SavedModel keep what the source has; so do models for one consumer (``--for``).
"""

from __future__ import annotations

from collections.abc import Mapping

from converters.compiler.passes.batch_branches import join_branches
from converters.compiler.passes.constant_chains import merge_constants, share, square_differences
from converters.compiler.passes.slice_of_concat import parts_for_slices
from converters.graph.nodes import Graph
from signatures.roles import Role
from signatures.spec import PolicySignature

#: What is joined of branches, so that their number can be told from the graph.
_OF_BRANCHES = (Role.SAMPLED, Role.DETERMINISTIC, Role.LOG_PROBS, Role.PROBS)


def lean(graph: Graph, signature: PolicySignature, fetches: Mapping[str, str]) -> Graph:
    """The same outputs, within the rounding of a constant or two, in fewer ops; made once for a graph."""
    of_branches = {fetches[s.name] for s in signature.outputs if s.role in _OF_BRANCHES}
    key = lean, tuple(fetches.values()), frozenset(of_branches)
    if key not in graph.made:
        made, roots = graph, fetches.values()
        for shorter in (parts_for_slices, share, merge_constants, square_differences):
            made = shorter(made, roots)
        graph.made[key] = join_branches(made, roots, of_branches)
    found: Graph = graph.made[key]
    return found
