"""Policy to ``<policy>.steps.json``, with the contract beside the steps."""

from __future__ import annotations

import json

from export_model.converters.compiler.targets import FEWER_OPS, prepare
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.steps.lowerings import lower
from export_model.converters.policy.policy import Policy


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The files, by their path in the bundle. Raises UnsupportedOpError that names what no step computes."""
    graph = prepare(policy, FEWER_OPS)
    matrices = {n.name for n in graph.nodes if n.value is not None and n.value.ndim > 1}
    steps = [lower(node, graph) for node in graph.nodes if node.name not in matrices]
    content = {"steps": steps, "contract": json.loads(options.contract)}
    return {f"{policy.name}.steps.json": Pieces(json.dumps(content).encode())}
