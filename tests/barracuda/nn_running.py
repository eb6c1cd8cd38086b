"""A written ``.nn`` run as Unity runs it, by the layer rules of ``reference``, under the policy's own names."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec.structs import replace

from export_model.converters.consumers.mlagents.version2 import dress_nn
from export_model.converters.formats.barracuda.format import NnModel
from export_model.converters.formats.barracuda.lower import policy_model
from export_model.converters.graph.nodes import Graph, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import ACTION_NAMES, Role
from export_model.signatures.spec import PolicySignature, TensorSpec
from tests.barracuda.reference import evaluate
from tests.graph.samples import Sample

Array = np.ndarray
Arrays = Mapping[str, Array]

_PLAIN = {Role.MASKS: "action_masks", Role.PREV_ACTION: "prev_action", Role.NOISE: "epsilon"}
_RANDOM_NORMAL = 64


def as_policy(sample: Sample) -> Policy | None:
    """A sample's graph as a policy; None where it is none: a batch is missing, or an input has no fixed width.

    Its inputs are vectors and images; its results, flattened, are the action.
    """
    specs = []
    nodes = []
    for node in sample.graph.nodes:
        if node.op != "Placeholder":
            nodes.append(node)
            continue
        array = sample.feeds[node.name]
        dims: TensorShape = node.attrs["shape"]
        if dims.dims is None or not dims.dims or dims.dims[0] is not None or None in dims.dims[1:] or array.ndim > 4:
            return None
        role = Role.VISUAL if array.ndim == 4 else Role.VECTOR
        specs.append(TensorSpec(node.name, role, array.dtype.name, dims.dims))
        nodes.append(node)
    if not specs:
        return None
    types = run_graph(sample.graph, sample.feeds, sample.fetches)
    outputs, fetches = [], {}
    for number, name in enumerate(sample.fetches):
        array = types[name]
        if array.ndim == 0 or len(array) != len(next(iter(sample.feeds.values()))):
            return None
        output = "action" if number == 0 else f"extra_{number}"
        outputs.append(
            TensorSpec(
                output, Role.CONTINUOUS if number == 0 else Role.OTHER, array.dtype.name, (None, *array.shape[1:])
            )
        )
        fetches[output] = name
    signature = PolicySignature(inputs=tuple(specs), outputs=tuple(outputs), family="test", action_space="continuous")
    return Policy("sample", Graph(tuple(nodes)), signature, {s.name: s.name for s in specs}, fetches)


def fed(policy: Policy, model: NnModel, feeds: Arrays) -> dict[str, Array]:
    """What Unity would feed: [N, H, W, C] under ML-Agents' names, the memory in its parts."""
    signature = policy.signature
    rows = signature.rows(feeds)
    found: dict[str, Array] = {}
    vectors = [s for s in signature.inputs if s.role is Role.VECTOR]
    if vectors:
        joined = np.concatenate([feeds[s.name].reshape(rows, -1) for s in vectors], axis=1)
        found["vector_observation"] = joined[:, None, None, :]
    for number, spec in enumerate(s for s in signature.inputs if s.role is Role.VISUAL):
        turned = signature.preprocess.get(spec.name, {}).get("layout") == "NCHW"
        image = feeds[spec.name]
        found[f"visual_observation_{number}"] = image.transpose(0, 2, 3, 1) if turned else image
    drawn = [layer.name for layer in model.layers if layer.type == _RANDOM_NORMAL]
    for role, name in _PLAIN.items():
        for number, spec in enumerate(s for s in signature.inputs if s.role is role):
            found[name if number == 0 else drawn[number - 1]] = feeds[spec.name].reshape(rows, 1, 1, -1)
    for given in model.inputs:
        if given.name == "action_masks" and given.name not in found:
            found[given.name] = np.ones((rows, *given.shape[1:]))
    memory = signature.memory
    if memory is not None and memory.input is not None:
        state, start = feeds[memory.input].reshape(rows, -1), 0
        for part in model.memories:
            found[part.input] = state[:, None, None, start : start + part.shape[3]]
            start += part.shape[3]
    assert set(found) >= {i.name for i in model.inputs}
    return found


def base_name(spec: TensorSpec) -> str:
    """An output's name without the scope of its brain, which names of the source have."""
    return spec.name.rpartition("/")[2]


def nn_model(policy: Policy) -> NnModel:
    """The policy's file before it is encoded, in the names of ML-Agents."""
    return policy_model(dress_nn(policy, "barracuda-1.0"))


def action_model(policy: Policy) -> NnModel:
    """The action alone, under the policy's own names."""
    outputs = tuple(s for s in policy.signature.outputs if s.name == "action")
    signature = replace(policy.signature, outputs=outputs)
    return policy_model(replace(policy, signature=signature, fetches={"action": policy.fetches["action"]}))


def action_of(policy: Policy, model: NnModel, feeds: Arrays) -> Array:
    """The action [B, …] of ``action_model``: images lie as the policy has them, rows of rows transposed."""
    rows, laid = policy.signature.rows(feeds), {}
    for given in model.inputs:
        array = np.asarray(feeds[given.name], np.float64)
        array = array.transpose(0, 2, 1) if array.ndim == 3 else array
        laid[given.name] = array.reshape(rows, *given.shape[1:])
    return evaluate(model, laid)["action"].reshape(rows, -1)


def answered(policy: Policy, model: NnModel, feeds: Arrays, dtype: type = np.float64) -> dict[str, Array]:
    """The policy's outputs as the file gives them, by the policy's names.

    A drawn action is its log-probabilities, a best class the one that scores highest in its branch, the memory its
    parts joined.
    """
    signature = policy.signature
    values = evaluate(model, fed(policy, model, feeds), dtype)
    rows = signature.rows(feeds)
    found: dict[str, Array] = {}
    for spec in signature.outputs:
        name = base_name(spec)
        if spec.role is Role.MEMORY_OUT:
            found[spec.name] = np.concatenate([values[m.output].reshape(rows, -1) for m in model.memories], axis=1)
        elif name in ACTION_NAMES and spec.role is Role.DETERMINISTIC and spec.dtype.startswith("int"):
            found[spec.name] = best(values[name].reshape(rows, -1), signature.branches)
        elif name in ACTION_NAMES or spec.role in (Role.VALUE, Role.ACTION_PROBS):
            found[spec.name] = values[name].reshape(rows, -1)
    return found


def best(scores: Array, branches: tuple[int, ...]) -> Array:
    """The highest score of each branch."""
    edges = np.cumsum(branches or (scores.shape[1],))[:-1]
    return np.stack([part.argmax(axis=1) for part in np.split(scores, edges, axis=1)], axis=1)


def wanted(policy: Policy, answers: Arrays) -> dict[str, Array]:
    """What a runtime of another format answers, as the file gives it."""
    found = {}
    scores = [s.name for s in policy.signature.outputs if s.role is Role.LOG_PROBS]
    for spec in policy.signature.outputs:
        value = answers[spec.name]
        if base_name(spec) in ACTION_NAMES and spec.role is Role.SAMPLED:
            value = answers[scores[0]]
        elif base_name(spec) in ACTION_NAMES and spec.role is Role.PROBS:
            with np.errstate(divide="ignore"):
                value = np.log(value)
        found[spec.name] = np.asarray(value, np.float64).reshape(len(value), -1)
    return found


def some(policy: Policy, rows: int, seed: int = 0) -> dict[str, Array]:
    """Observations at random; every branch has an allowed action."""
    rng = np.random.default_rng(seed)
    branches = policy.signature.branches
    return {s.name: _drawn(s, rows, branches, rng) for s in policy.signature.inputs}


def _drawn(spec: TensorSpec, rows: int, branches: tuple[int, ...], rng: np.random.Generator) -> Array:
    shape = [rows if d is None else d for d in spec.shape]
    if spec.role is Role.MASKS:
        masks = rng.random(shape) > 0.3
        for last in np.cumsum(branches or shape[1:]):
            masks[:, int(last) - 1] = True
        return masks.astype(spec.dtype)
    if spec.role is Role.VISUAL:
        return rng.uniform(0, 1, shape).astype(spec.dtype)
    if spec.dtype.startswith("int"):
        return rng.integers(0, min(branches or (2,)), shape).astype(spec.dtype)
    return rng.normal(0, 1, shape).astype(spec.dtype)
