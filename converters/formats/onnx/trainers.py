"""Which trainer wrote an ONNX model, what follows from that, and which of its faults the user should know.

ML-Agents' PyTorch exporter (model_serialization.py, 0.20 to 1.1), tf2onnx inside its TensorFlow trainers (0.15 to
0.23), this tool itself (its contract is in the metadata), and other trainers by what they call their tensors.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from msgspec.structs import replace

from export_model.converters.formats.embed import contract_of, redrawn
from export_model.converters.formats.embed import facts_of as facts_of_contract
from export_model.converters.formats.onnx.output_roles import output_roles, positional
from export_model.converters.formats.onnx.reader import OnnxModel
from export_model.converters.formats.onnx.tensor_map import TENSORS_KEY
from export_model.converters.graph.nodes import Graph, NameScope, Node, topological
from export_model.converters.graph.ops.table import passes_on, traits
from export_model.converters.interfaces.metadata import read_metadata
from export_model.converters.policy.brains import depends_on_input
from export_model.converters.policy.facts import DOUBLES_NARROWED, SourceFacts
from export_model.converters.policy.generations import SAC_MEAN, torch_generation
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.roles import CONSTANT_NAMES, TRAINER_VERSION, VERSION_NUMBER, Role

#: What only policies (and critics) call their inputs and outputs.
_OF_A_POLICY = re.compile(
    r"obs|state|act(ion)?s?($|_)|polic|logits|value|critic|actor|agent|goal|vec|mean|(^|_)(pi|mu|q|vf|std|sigma)($|_)"
)
_COLOURS = (1, 3, 4)
_IMAGE = 4


def understand(model: OnnxModel) -> tuple[Graph, SourceFacts]:
    """The graph, faults of old exporters repaired where the repair is the same at batch 1, and the facts."""
    text = model.metadata.get(EMBEDDED)
    if text is not None:
        contract = contract_of(text)
        facts = facts_of_contract(model.graph, contract, model.outputs)
        return redrawn(model.graph, contract), replace(facts, rows=contract.tool.get("batch"))
    version = model.graph.constant(VERSION_NUMBER) if VERSION_NUMBER in model.graph else None
    number = 0 if version is None or version.size != 1 else int(version.reshape(()))
    graph, notes = _with_rows_first(model)
    rows = 1 if model.one_row or notes else model.batch
    facts = SourceFacts(
        image_layout=_image_layout(model),
        rows=rows,
        from_end=True,
        outputs=dict.fromkeys(model.outputs.values()),
        memories=model.memories or None,
        model_name=model.name,
        decisions=model.decisions,
        interface=read_metadata({k: v for k, v in model.metadata.items() if k != TENSORS_KEY}),
    )
    if model.producer.startswith("tf2onnx"):
        facts = _of_tensorflow(model, facts, number)
    elif number:
        facts = _of_torch(model, facts, number)
    else:
        decisions = output_roles(model)
        roles = {n: d.role for n, d in decisions.items()}
        graph = _with_spreads(model, graph, roles)
        notes += _notes_of_constants(model, roles)
        facts = replace(facts, family="own model", outputs=roles, notes=_notes_of_others(model))
        facts = replace(facts, decisions={**model.decisions, **decisions})
        if positional(model):
            facts = replace(facts, family="Stable-Baselines3")
    return graph, replace(facts, notes=(*facts.notes, *notes, *_common_notes(model)))


def _image_layout(model: OnnxModel) -> str:
    """tf2onnx leaves images NHWC, PyTorch has them NCHW; a model of neither shows its colours where it has them."""
    if model.producer.startswith("tf2onnx"):
        return "NHWC"
    images = [s for s in (model.shapes.get(n) for n in model.inputs.values()) if s is not None and len(s) == _IMAGE]
    if images and all(s[3] in _COLOURS and s[1] not in _COLOURS for s in images):
        return "NHWC"
    return "NCHW"


# ------------------------------------------------------------------ ML-Agents


def _of_tensorflow(model: OnnxModel, facts: SourceFacts, version: int) -> SourceFacts:
    """0.15 to 0.23. The constants of 0.15 and 0.16 are initializers; later ones tell the version by themselves."""
    told = TRAINER_VERSION[0] in model.graph
    notes = []
    if model.integer_seeds:
        notes.append(
            "a sampler's seed is an integer where ONNX says float (a fault of tf2onnx 1.5.5): onnxruntime refuses the "
            "file; for the comparison it is repaired in memory"
        )
    return replace(facts, family="ML-Agents 0.15-0.16" if version and not told else None, notes=tuple(notes))


def _of_torch(model: OnnxModel, facts: SourceFacts, version: int) -> SourceFacts:
    outputs = model.outputs
    notes = []
    if "action" in outputs and "continuous_actions" in outputs:
        if len(model.draws) > 1:
            notes.append(
                "action and continuous_actions are two independent draws of one action in the source (ML-Agents 0.23 "
                "to 0.25); one of them is exported, with one epsilon"
            )
        else:
            notes.append("continuous_actions is the same as action; it is exported once")
    if "action" in outputs and "discrete_actions" in outputs:
        notes.append("discrete_actions is the same as action; it is exported once")
    raw = outputs.get("deterministic_continuous_actions")
    if raw is not None and "continuous_actions" in outputs and _is_squashed(model.graph, outputs["continuous_actions"]):
        notes.append(SAC_MEAN)
    return replace(
        facts,
        family=torch_generation(version, model.inputs, outputs),
        memory_layout=("h", "c") if "LSTM" in model.kinds else (),
        notes=tuple(notes),
    )


def _is_squashed(graph: Graph, name: str) -> bool:
    """Whether an action is a tanh (SAC)."""
    node = graph[name]
    while passes_on(node) or traits(node).moves == "join":
        node = graph.producer(node.inputs[0])
    return node.op == "Tanh"


def _with_rows_first(model: OnnxModel) -> tuple[Graph, list[str]]:
    """Memories that come out as an LSTM has them, [1, B, n], as [B, 1, n]: at batch 1 that is the same.

    ML-Agents 0.25 joined the LSTM's states to recurrent_out without turning them; models that were exported for one
    row need not turn them. TF Serving asks for the batch axis first.
    """
    graph, notes = model.graph, []
    names = NameScope(n.name for n in graph.nodes)
    separate = {m.output for m in model.memories}
    for value, name in model.outputs.items():
        shape = model.shapes.get(name)
        if name in separate or shape is None or len(shape) != 3 or shape[0] != 1 or not isinstance(shape[1], str):
            continue
        if value != "recurrent_out" and model.batch != 1:
            continue
        inner, target = names.fresh(f"{name}/time_first"), names.fresh(f"{name}/shape")
        graph = graph.rename({name: inner})
        rows = Node(target, "Const", value=np.array([-1, 1, int(shape[2])], np.int32))
        turned = Node(name, "Reshape", (inner, target), origin=graph[inner].origin)
        graph = Graph(topological([*graph.nodes, rows, turned]))
        if model.batch is None:
            notes.append(
                "the source handles its memory rightly for one row only (a fault of ML-Agents 0.25); the export takes "
                "any number of rows and is compared with the source row by row"
            )
    return graph, notes


# ------------------------------------------------------------------ other trainers


def _with_spreads(model: OnnxModel, graph: Graph, roles: Mapping[str, Role | None]) -> Graph:
    """The graph with spreads that depend on no input as rows: a parameter of the network has none of its own.

    A row is the constant added to 0 times the action, which every runtime computes for any number of rows.
    """
    action = next((n for n, role in roles.items() if role is Role.ACTION), None)
    names = NameScope(n.name for n in graph.nodes)
    for node, role in roles.items():
        shape = model.shapes.get(node)
        if role not in (Role.STD, Role.LOG_STD) or action is None or (shape and isinstance(shape[0], str)):
            continue
        inner, zero, rows = (names.fresh(f"{node}/{word}") for word in ("constant", "zero", "rows"))
        graph = graph.rename({node: inner})
        made = (
            Node(zero, "Const", value=np.zeros((), np.float32)),
            Node(rows, "Mul", (action, zero)),
            Node(node, "AddV2", (rows, inner)),
        )
        graph = Graph(topological([*graph.nodes, *made]))
    return graph


def _notes_of_others(model: OnnxModel) -> tuple[str, ...]:
    if not positional(model):
        names = [n.lower() for n in (*model.inputs, *model.outputs)]
        if not any(_OF_A_POLICY.search(n) for n in names):
            return (
                "nothing marks this file as a policy: no input or output has a name that trainers give "
                f"({', '.join((*model.inputs, *model.outputs))}); what it computes is exported all the same",
            )
        return ()
    names = list(model.outputs)
    order = f"{names[0]} is the action, {names[1]} the value"
    return (f"outputs by their order, as Stable-Baselines3's policies give them: {order}",)


def _notes_of_constants(model: OnnxModel, roles: Mapping[str, Role | None]) -> list[str]:
    """Outputs that no input changes, and that no name explains: one may be what a Gaussian action is spread by."""
    fed = depends_on_input(model.graph)
    unnamed = (v for v, n in model.outputs.items() if roles.get(n) is None and n not in fed)
    return [
        f"the output {name} is the same for every input and is left out; if it is how far the action spreads, "
        "call it std or log_std in the model"
        for name in unnamed
        if name not in CONSTANT_NAMES
    ]


def _common_notes(model: OnnxModel) -> list[str]:
    notes = [f"the output {name} is left out: {why}" for name, why in model.left_out.items()]
    if model.alone:
        notes.append(
            "the model decides for one agent at a time; an axis for the agents is added: the export takes any number, "
            "each row computed as the model computes one, and is compared with the source row by row"
        )
    elif model.batch is not None:
        rows = "1 row" if model.batch == 1 else f"{model.batch} rows"
        notes.append(
            f"the model was exported for {rows} only; the export takes any number of rows and is compared with the "
            f"source {rows} at a time"
        )
    if model.halves:
        notes.append("the source is in half precision (16 bits); it is read, run and compared as float32")
    if model.doubles:
        notes.append(DOUBLES_NARROWED)
    return notes
