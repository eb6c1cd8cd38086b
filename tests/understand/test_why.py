"""Which rule decided: every rule of the tables decides somewhere, and ``inspect --why`` and errors say its sentence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.compile import explanations
from export_model.converters.formats.onnx.output_roles import _BESIDE, _BY_NAME, output_roles
from export_model.converters.formats.onnx.reader import OnnxModel
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.policy.brains import _ACTIONS, _DECLARED_ACTIONS, explain_outputs, find_brains
from export_model.converters.policy.input_rules import BY_NAME, BY_READERS, LAST_RESORTS
from export_model.converters.policy.inputs import classify_inputs, explain_inputs
from export_model.converters.policy.rules import RoleDecision
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError, SignatureError
from export_model.signatures.roles import Role
from tests import commands, known
from tests.exporting import inspect_model
from tests.signatures.nodes import FLOAT, INT, Dims, constant, graph, op, placeholder

UINT8 = np.dtype(np.uint8)
FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"
KNOWN = [placeholder("obs_0", (None, 3)), op("seen", "Tanh", "obs_0")]
REMEMBERED = [placeholder("recurrent_in", (None, 4)), op("kept", "Tanh", "recurrent_in")]


def used(name: str, kind: str) -> list[Node]:
    """What reads an input."""
    if kind == "one-hot":
        numbers = [constant(f"{name}/depth", np.int32(4)), constant(f"{name}/on", 1.0), constant(f"{name}/off", 0.0)]
        return [*numbers, op("used", "OneHot", name, *(n.name for n in numbers))]
    if kind == "table":
        table = [constant(f"{name}/table", np.ones((4, 3), np.float32)), constant(f"{name}/axis", np.int32(0))]
        return [*table, op("used", "GatherV2", table[0].name, name, table[1].name)]
    if kind == "mask":
        scores = [constant(f"{name}/scores", np.ones((1, 4), np.float32)), op("soft", "Softmax", f"{name}/scores")]
        return [*scores, op("used", "Mul", name, "soft")]
    if kind == "colours":
        return [constant(f"{name}/byte", np.float32(255)), op("used", "RealDiv", name, f"{name}/byte")]
    return [op("used", "Tanh", name)]


def read(dims: Dims, dtype: np.dtype = FLOAT, kind: str = "", name: str = "x", beside: Sequence[Node] = ()) -> Graph:
    """A policy that takes an input of no known name, and what stands ``beside`` it."""
    nodes = [*beside, placeholder(name, dims, dtype), *used(name, kind)]
    tensors = [n.name for n in beside if n.op == "Tanh"]
    return graph(*nodes, op("sum", "AddN", "used", *tensors), op("action", "Tanh", "sum"))


#: rule of BY_READERS → a graph in which it decides, and whether the format declares inputs
READ: list[tuple[Graph, bool]] = [
    (read((None, 84, 84, 3)), False),
    (read((None, 7, 7, 3), UINT8, "colours"), False),
    (read((None,), INT, "one-hot", beside=[*KNOWN, *REMEMBERED]), False),
    (read((None, 1), INT, "one-hot"), True),
    (read((None, 1), INT, "one-hot", beside=KNOWN), False),
    (read((None,), INT, "table"), True),
    (read((None, 4), name="hidden", beside=KNOWN), True),
    (read((None, 4)), True),
    (read((None, 4), kind="mask", beside=[*KNOWN, *REMEMBERED]), True),
    (read((None, 6, 5)), True),
    (read((None, None, 5)), True),
    (read((None, 6, 7, 2)), True),
    (read((2, 2), beside=KNOWN), False),
]


def decided(g: Graph, *, declared: bool) -> dict[str, RoleDecision]:
    (brain,) = find_brains(g)
    return {d.tensor: d for d in explain_inputs(g, brain, {}, {}, {}, declared=declared)}


def first_unknown(g: Graph) -> str:
    return next(n.name for n in g.nodes if n.op == "Placeholder" and n.name in ("x", "hidden"))


@pytest.mark.parametrize("number", range(len(READ)))
def test_every_rule_on_what_reads_an_input_decides(number: int) -> None:
    g, declared = READ[number]
    name, rule = first_unknown(g), BY_READERS[number]
    try:
        decision = decided(g, declared=declared)[name]
    except SignatureError as error:  # a lone memory is no observation
        assert rule.says in (error.why or "")
        return
    assert (decision.role, decision.says) == (rule.role, rule.says)


def test_every_rule_is_shown() -> None:
    assert len(READ) == len(BY_READERS)
    resorts = [(read((None, 4)), False), (read((None, 1), INT), True)]
    for (g, declared), rule in zip(resorts, LAST_RESORTS, strict=True):
        assert decided(g, declared=declared)["x"].says == rule.says


def test_every_rule_on_names_decides() -> None:
    dims = {Role.VISUAL: (None, 84, 84, 3), Role.ENTITIES: (None, 5, 4), Role.MEMORY_IN: (None, 4), None: (None, 3)}
    counted = (Role.PREV_ACTION, Role.SEQUENCE_LENGTH, Role.BATCH_SIZE)
    said = set()
    for name in ("state", "vector_observation", "obs_0", "visual_observation", "entities_0", "obs", "epsilon",
                 "action_masks", "prev_action", "memories", "sequence_length_1", "batch_size",
                 "observation.state", "observation.images.top"):  # fmt: skip
        for rule in BY_NAME:
            role = Role(rule.role)
            shape = (None,) if role in counted else dims.get(role, dims[None])
            g = read(shape, INT if role in counted else FLOAT, name=name, beside=KNOWN if name != "obs_0" else ())
            try:
                said.add(decided(g, declared=False)[name].says)
            except SignatureError:
                continue
    assert {rule.says for rule in BY_NAME} <= said


def test_what_spoke_against_a_decision_is_said() -> None:
    history = decided(read((None, 6, 5), name="obs_0"), declared=True)["obs_0"]
    assert history.role is Role.ENTITIES
    assert any("history" in text and "vector_observation" in text for text in history.against)
    board = decided(read((None, 6, 7, 2), name="observation"), declared=True)["observation"]
    assert board.role is Role.VECTOR
    assert any("20x20" in text for text in board.against)


def test_the_user_decides_and_what_the_name_says_is_against_it() -> None:
    g = read((None, 4), name="action_masks", beside=KNOWN)
    (brain,) = find_brains(g)
    decisions = explain_inputs(g, brain, {"action_masks": Role.PARAMETER}, {}, {}, declared=False)
    masks = next(d for d in decisions if d.tensor == "action_masks")
    assert (masks.role, masks.says) == (Role.PARAMETER, "--input says so")
    assert any("masks" in text for text in masks.against)


def test_errors_say_what_the_rules_say() -> None:
    with pytest.raises(SignatureError) as caught:
        decided(read((None, 4), INT, beside=KNOWN), declared=True)
    assert f"x: {BY_READERS[-1].says}" in str(caught.value)
    with pytest.raises(SignatureError) as caught:
        decided(read((None, 4), INT, name="action_masks", beside=KNOWN), declared=True)
    assert "its name is that of masks in ML-Agents, which is of floats" in str(caught.value)
    with pytest.raises(SignatureError) as caught:
        decided(read((2, 2, 2)), declared=False)
    assert BY_READERS[-1].says in str(caught.value)
    several = graph(placeholder("obs_0"), op("net/policy", "Tanh", "obs_0"), op("net/policy_1", "Tanh", "obs_0"))
    with pytest.raises(SignatureError) as caught:
        find_brains(several)
    assert f"net/policy, net/policy_1: {_ACTIONS[0].says}" in str(caught.value)


# ------------------------------------------------------------------ outputs


def model(shapes: dict[str, tuple[Any, ...]]) -> OnnxModel:
    return cast(OnnxModel, SimpleNamespace(outputs={n: n for n in shapes}, shapes=shapes, inputs={"obs": "obs"}))


def test_every_rule_on_the_names_of_outputs_decides() -> None:
    wide, one = ("B", 3), ("B", 1)
    names = ("action", "continuous_actions", "discrete_actions", "action_probs", "value_estimate", "recurrent_out",
             "action_log_probs", "deterministic_action", "deterministic_continuous_actions", "q_values",
             "deterministic_discrete_actions", "action_std", "action_log_std", "action_log_prob")  # fmt: skip
    files = [{name: wide, "pi": wide} for name in names]
    files += [{"mean": wide, "v": one, "std": wide}, {"q": wide}, {"mu": wide, "q_net": ("B", 3, 2)}]
    files += [{"logits": wide, "log_sigma": wide, "logp_x": one, "log_prob": one}, {"q_vAlues": wide}]
    said = {text for f in files for d in output_roles(model(f)).values() for text in (d.says, *d.against)}
    assert {rule.says for rule in (*_BY_NAME, *_BESIDE)} <= said


def test_an_output_beside_the_action_says_why_it_is_none() -> None:
    found = output_roles(model({"action": ("B", 3), "mean": ("B", 3)}))
    assert found["action"].role is Role.ACTION
    assert found["mean"].role is None
    assert "the action is action" in found["mean"].says
    assert found["mean"].against == (_BY_NAME_OF_MEAN,)


_BY_NAME_OF_MEAN = next(rule.says for rule in _BY_NAME if "the mean or the scores" in rule.says)


@pytest.mark.parametrize(
    ("nodes", "declared", "number"),
    [
        ([op("net/policy", "Tanh", "obs_0"), op("net/other", "Tanh", "obs_0")], False, 0),
        ([op("net/q_values_1", "Tanh", "obs_0"), op("net/other", "Tanh", "obs_0")], False, 1),
        ([constant("axis", 1), op("best", "ArgMax", "obs_0", "axis"), op("other", "Tanh", "obs_0")], True, 2),
        ([op("net/mu", "Tanh", "obs_0"), op("net/other", "Tanh", "obs_0")], True, 3),
    ],
)
def test_every_rule_on_nameless_actions_decides(nodes: list[Node], declared: bool, number: int) -> None:
    g = graph(placeholder("obs_0"), *nodes)
    outputs = {n.name: None for n in nodes if n.value is None}
    (brain,) = find_brains(g, declared=outputs if declared else None)
    action = next(d for d in explain_outputs(brain, {}) if d.role is Role.ACTION)
    assert action.says == (*_ACTIONS, *_DECLARED_ACTIONS)[number].says


# ------------------------------------------------------------------ files


def test_inspect_why_says_the_rules_in_text_and_json() -> None:
    source = FIXTURES / "recurrent.bytes"
    shown = commands.export_model("inspect", source, "--why")
    assert shown.status == 0
    text = " ".join(shown.out.split())
    assert (
        "recurrent_in:0: memory_in, because its name and its number of axes are those of memory_in in ML-Agents" in text
    )
    assert "action:0: action, because its name is that of action" in text
    plain, told = (
        commands.export_model("inspect", source, "--json"),
        commands.export_model("inspect", source, "--why", "--json"),
    )
    (without,), (given,) = plain.json["policies"], told.json["policies"]
    assert "why" not in without
    assert {w["tensor"] for w in given["why"]} >= {"state:0", "recurrent_in:0", "action:0"}
    assert all(w["because"] and isinstance(w["against"], list) for w in given["why"])
    assert inspect_model(source, why=True).policies[0].decisions
    refused = commands.export_model("inspect", source, "--why", "--unity", "R22")
    assert refused.status == 2
    assert "--why is not for --unity" in refused.err


@pytest.mark.corpus
@pytest.mark.parametrize("path", known.params(known.sources()))
def test_what_is_explained_is_what_was_decided(path: Path) -> None:
    found = {p.name: p for p in known.policies_or_skip(path)}
    source = read_source(path)
    for made in source.models:
        try:
            explained = explanations(made.graph, source.stem(made), None, made.facts)
        except ExportModelError:
            continue
        for name in explained.keys() & found.keys():
            signature = found[name].signature
            roles = {d.tensor: d.role for d in explained[name]}
            for spec in signature.inputs:
                shown = ", ".join(spec.source) if isinstance(spec.source, tuple) else spec.source
                if shown in roles and spec.role is not Role.NOISE:
                    assert roles[shown] is spec.role, f"{shown} of {path.name}"
            assert all(d.says for d in explained[name])
            assert any(d.role in (Role.ACTION, Role.Q_VALUES) for d in explained[name])


def test_no_role_hangs_on_what_is_explained() -> None:
    g, declared = READ[7]
    (brain,) = find_brains(g)
    roles = classify_inputs(g, brain, declared=declared)
    assert {n: d.role for n, d in decided(g, declared=declared).items()} == roles
    assert classify_inputs(g, replace(brain, says={}), declared=declared) == roles
