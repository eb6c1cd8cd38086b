"""What each target's writer asks of a graph before it encodes it: a named list of steps per target.

``.bytes`` keeps what the source has, and has no list. A step takes a graph and says of the same outputs
the same, within the rounding of a constant or two.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial

from msgspec import Struct

from export_model.converters.compiler.passes.batch_branches import join_branches
from export_model.converters.compiler.passes.clip_by_value import clip_by_value
from export_model.converters.compiler.passes.constant_chains import (
    drop_zero_biases,
    merge_constants,
    share,
    square_differences,
)
from export_model.converters.compiler.passes.fuse import fuse
from export_model.converters.compiler.passes.int8_products import multiply_products
from export_model.converters.compiler.passes.layout_views import transpose_layout_views
from export_model.converters.compiler.passes.lowering import (
    lower_for_conversion,
    lower_for_importers,
    lower_for_nn,
    lower_for_tfjs,
)
from export_model.converters.compiler.passes.slice_of_concat import parts_for_slices
from export_model.converters.compiler.passes.unjoined_products import keep_products_unjoined
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role


class Outputs(Struct, frozen=True):
    """Tensors that a step keeps.

    ``roots`` are all of them, ``branches`` those that are joined of branches, so that the number of branches can be
    told from the graph.
    """

    roots: tuple[str, ...]
    branches: frozenset[str] = frozenset()


Step = Callable[[Graph, Outputs], Graph]


def _on_roots(function: Callable[[Graph, Collection[str]], Graph]) -> Step:
    return lambda graph, outputs: function(graph, outputs.roots)


def _on_ends(function: Callable[[Graph, Collection[str]], Graph]) -> Step:
    """Give a function the outputs, and the nodes that nothing reads: a trainer's constants, which Unity looks up."""

    def step(graph: Graph, outputs: Outputs) -> Graph:
        readers = graph.consumers()
        return function(graph, [*outputs.roots, *(n.name for n in graph.nodes if not readers[n.name])])

    return step


#: Fewer ops, for runtimes in which the start of an op is most of a small policy's run.
FEWER_OPS: tuple[Step, ...] = (
    _on_roots(parts_for_slices),
    _on_roots(share),
    _on_roots(merge_constants),
    _on_roots(square_differences),
    lambda graph, outputs: join_branches(graph, outputs.roots, outputs.branches),
)
_FUSE: Step = _on_roots(partial(fuse, activations=False))
_FUSE_ACTIVATIONS: Step = _on_roots(partial(fuse, activations=True))
_LOWER_FOR_TFJS: tuple[Step, ...] = (_on_roots(lower_for_tfjs), _on_roots(clip_by_value))

TFJS = (*FEWER_OPS, *_LOWER_FOR_TFJS, _FUSE_ACTIVATIONS)
TFJS_INT8 = (*FEWER_OPS, *_LOWER_FOR_TFJS, _on_roots(multiply_products), _FUSE_ACTIVATIONS)
ONNX = (*FEWER_OPS, _FUSE, lambda graph, outputs: lower_for_importers(graph))
LITERT = (*FEWER_OPS, _FUSE, _on_roots(drop_zero_biases))
PROGRAM = (*FEWER_OPS, _FUSE)
#: What the official converter makes a TensorFlow.js model of that runs.
SAVED_MODEL = (_on_ends(lower_for_conversion), _on_ends(keep_products_unjoined))
#: Models for one consumer stay as they were tried in it: without a Split, whether it reads one or not.
CONSUMER_ONNX = (_on_roots(transpose_layout_views), _FUSE)
_UNTRIED = frozenset({"Split"})
BARRACUDA = (_FUSE, _on_roots(lower_for_nn))


def consumer_onnx(misread: Collection[str]) -> tuple[Step, ...]:
    """Return the steps for importers that lack or misread some ONNX ops."""
    return (*CONSUMER_ONNX, lambda graph, outputs: lower_for_importers(graph, _UNTRIED.union(misread)))


_OF_BRANCHES = (Role.SAMPLED, Role.DETERMINISTIC, Role.LOG_PROBS, Role.PROBS)


def prepare(policy: Policy, steps: tuple[Step, ...]) -> Graph:
    """Return the policy's graph after a target's steps."""
    branches = frozenset(policy.fetches[s.name] for s in policy.signature.outputs if s.role in _OF_BRANCHES)
    return run_steps(policy.graph, Outputs(tuple(policy.fetches.values()), branches), steps)


def run_steps(graph: Graph, outputs: Outputs, steps: tuple[Step, ...]) -> Graph:
    """Return the graph after the steps. ``FEWER_OPS``, with which several targets begin, run once for a graph."""
    shared = len(FEWER_OPS)
    if steps[:shared] == FEWER_OPS:
        key = FEWER_OPS, outputs
        if key not in graph.cache:
            graph.cache[key] = _run(graph, outputs, FEWER_OPS)
        graph, steps = graph.cache[key], steps[shared:]
    return _run(graph, outputs, steps)


def _run(graph: Graph, outputs: Outputs, steps: tuple[Step, ...]) -> Graph:
    for step in steps:
        graph = step(graph, outputs)
    return graph
