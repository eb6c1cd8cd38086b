"""Policy to a SavedModel (saved_model.proto, meta_graph.proto), without TensorFlow.

Below 2 GiB there is no ``variables`` folder: the graph has no variables, and neither loader of TensorFlow nor
TensorFlow Serving asks for one then.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from export_model.converters.compiler.passes.weights import store_compactly
from export_model.converters.compiler.targets import SAVED_MODEL, prepare
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.chunks import Pieces
from export_model.converters.files.external_data import Detached, is_readable
from export_model.converters.formats.embed import with_contract
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.formats.frozen_graph.writer import serialise_graph
from export_model.converters.formats.saved_model.variables import files_of
from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.converters.policy.policy import Policy
from export_model.signatures.digest import sha256_hex
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

FOLDER = "saved_model"
SERVING, DETERMINISTIC = "serving_default", "deterministic"
METHOD = "tensorflow/serving/predict"


def signatures_of(policy: Policy) -> dict[str, tuple[list[TensorSpec], list[TensorSpec]]]:
    """Signature key → (inputs, outputs).

    ``serving_default`` has all of both; ``deterministic`` has the outputs that need no noise, and their inputs.
    """
    every = policy.signature
    signatures = {SERVING: (list(every.inputs), list(every.outputs))}
    noise = {policy.feeds[s.name] for s in every.inputs if s.role is Role.NOISE}
    samplers = {n.name for n in policy.graph.nodes if n.op in SAMPLERS}
    drawn = policy.graph.descendants(noise | samplers)
    outputs = [s for s in every.outputs if node_of(policy.fetches[s.name]) not in drawn]
    upstream = policy.graph.ancestors(policy.fetches[s.name] for s in outputs)
    inputs = [s for s in every.inputs if policy.feeds[s.name] in upstream]
    if outputs and inputs:
        signatures[DETERMINISTIC] = (inputs, outputs)
    return signatures


def _fill(entries: Any, specs: Iterable[TensorSpec]) -> None:
    for spec in specs:
        info = entries[spec.name]
        info.name = f"{spec.name}:0"
        info.dtype = schema.dtype_number(np.dtype(spec.dtype))
        for size in spec.shape:
            info.tensor_shape.dim.add(size=-1 if size is None else size)


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The SavedModel artefact.

    Its graph is that of the ``.bytes`` unless a converter would misread it, put between the other fields as it was
    serialised; protobuf is given it again where the weights become variables.
    """
    graph = prepare(policy, SAVED_MODEL)
    about, signed = schema.MetaGraphDef(), schema.MetaGraphDef()
    about.meta_info_def.tags.append("serve")
    for key, (inputs, outputs) in signatures_of(policy).items():
        definition = signed.signature_def[key]
        definition.method_name = METHOD
        _fill(definition.inputs, inputs)
        _fill(definition.outputs, outputs)
    version = schema.SavedModel(saved_model_schema_version=1)
    meta = Pieces(
        schema.serialise(about),
        schema.field(2, serialise_graph(graph, options.contract, options.weights)),
        schema.serialise(signed),
    )
    whole = Pieces(schema.serialise(version), schema.field(2, meta))
    if is_readable(whole):
        return {f"{FOLDER}/saved_model.pb": whole}
    detached = Detached()
    about.MergeFrom(signed)
    about.graph_def.CopyFrom(
        encode(with_contract(store_compactly(graph, options.weights), options.contract), detached=detached)
    )
    version.meta_graphs.append(about)
    files = files_of(version, detached, sha256_hex(options.contract.encode()))
    return {f"{FOLDER}/{path}": data for path, data in files.items()}
