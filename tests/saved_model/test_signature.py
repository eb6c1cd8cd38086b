"""Signatures of models put into their graphs: which output is which, whatever the keys and nodes are called."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.reader import from_graph_def, read_graph
from export_model.converters.formats.saved_model.lengths import without_counted
from export_model.converters.formats.saved_model.reader import read_saved_model
from export_model.converters.formats.saved_model.signature import ModelSignature, TensorInfo, expose
from export_model.converters.formats.saved_model.signature import expose_signature as with_facts
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import infer_types
from export_model.converters.policy.facts import SourceFacts
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError
from export_model.signatures.roles import Role
from fixtures import path as fixture
from tests.handmade import constant, continuous_policy, graph_def
from tests.handmade import node as tf_node

F32 = np.dtype(np.float32)
X = np.array([[1, -2]], np.float32)


def graph(*names: str) -> Graph:
    """x → names[0] = x + 1 → names[1] = that + 1 …"""
    nodes = [
        Node("x", "Placeholder", (), {"dtype": F32, "shape": TensorShape((None, 2))}, origin="x:0"),
        Node("one", "Const", value=np.array(1, np.float32)),
    ]
    for name in names:
        nodes.append(Node(name, "Add", (nodes[-1].name if len(nodes) > 2 else "x", "one"), origin=f"{name}:0"))
    return Graph(tuple(nodes))


def exposed(base: Graph, inputs: dict[str, str], outputs: dict[str, str]) -> tuple[Graph, dict[str, Role]]:
    sides = [{k: TensorInfo(v, F32) for k, v in side.items()} for side in (inputs, outputs)]
    return expose(base, ModelSignature(*sides))


def value(base: Graph, name: str) -> float:
    return float(run_graph(base, {"x": X}, [name])[name][0, 0])


def test_one_output_is_the_action() -> None:
    made, roles = exposed(graph("a", "b"), {"in": "x:0"}, {"out": "b:0"})
    assert value(made, "action") == 3
    assert made["action"].origin == "b:0"
    assert roles == {}
    made, _ = exposed(graph("a", "recurrent_out"), {}, {"out": "a:0", "memory": "recurrent_out:0"})
    assert (value(made, "action"), value(made, "recurrent_out")) == (2, 3)


def test_keys_go_before_nodes_names() -> None:
    made, roles = exposed(
        graph("action", "value_estimate"),
        {"state": "x:0"},
        {"action": "value_estimate:0", "value_estimate": "action:0"},
    )
    assert (value(made, "action"), value(made, "value_estimate")) == (3, 2)
    assert made["action"].origin == "value_estimate:0"
    assert roles == {"x": Role.VECTOR}


def test_an_inner_node_of_that_name_gives_way() -> None:
    made, _ = exposed(graph("action", "b"), {}, {"action": "b:0"})
    assert value(made, "action") == 3
    assert made["action"].origin == "b:0"
    assert any(n.origin == "action:0" for n in made.nodes)


def test_several_unknown_outputs_keep_their_keys() -> None:
    made, _ = exposed(graph("a", "b"), {}, {"left out": "a:0", "right/out": "b:0"})
    assert (value(made, "left_out"), value(made, "right/out")) == (2, 3)
    assert "action" not in made


def test_what_the_signature_does_not_name_is_gone() -> None:
    made, _ = exposed(graph("action", "value_estimate"), {}, {"out": "action:0"})
    assert "value_estimate" not in made


def test_an_input_in_the_middle_becomes_the_placeholder() -> None:
    made, roles = exposed(graph("a", "b"), {"vector_observation": "a:0"}, {"out": "b:0"})
    assert made["a"].op == "Placeholder"
    assert "x" not in made
    assert roles == {"a": Role.VECTOR}


def test_an_output_may_be_a_further_one_of_its_node() -> None:
    base = graph("a", "b")
    both = Node("both", "IdentityN", ("a", "b"))
    last = Node("last", "Add", ("both", "both:1"))
    made, _ = exposed(Graph((*base.nodes, both, last)), {}, {"out": "last:0", "second": "both:1"})
    assert made["second"].origin == "both:1"
    made = normalise(made)
    assert value(made, "out") == 5
    assert value(made, "second") == 3


def test_a_signature_of_another_graph() -> None:
    with pytest.raises(DamagedFileError, match=r"'out' is the tensor 'gone:0', which is not in the graph"):
        exposed(graph("a"), {}, {"out": "gone:0"})


# ------------------------------------------------------------------ files


def saved(keys: dict[str, tuple[str, ...]], tags: tuple[str, ...] = ("serve",)) -> bytes:
    """A SavedModel with these signatures, key → outputs; the graph is that of a fixture."""
    message = schema.SavedModel(saved_model_schema_version=1)
    meta = message.meta_graphs.add()
    meta.meta_info_def.tags.extend(tags)
    meta.graph_def.ParseFromString(fixture("continuous.bytes").read_bytes())
    for key, outputs in keys.items():
        for name in outputs:
            meta.signature_def[key].outputs[name].name = f"{name}:0"
            meta.signature_def[key].outputs[name].dtype = 1
    return schema.serialise(message)


def test_the_serving_signature_goes_first() -> None:
    assert (
        read_saved_model(saved({"a": ("action",), "serving_default": ("action",)})).signature.key == "serving_default"
    )
    found = read_saved_model(saved({"b": ("action",), "a": ("action",), "__saved_model_init_op": ("x",), "c": ()}))
    assert (found.signature.key, found.keys) == ("a", ("a", "b"))


def test_a_saved_model_without_signatures_goes_by_names(tmp_path: Path) -> None:
    (tmp_path / "saved_model.pb").write_bytes(saved({}))
    (policy,) = read_source(tmp_path).policies()
    assert policy.name == tmp_path.name
    (frozen,) = read_source(fixture("continuous.bytes")).policies()
    assert policy.signature == frozen.signature


def test_a_saved_model_without_a_graph() -> None:
    with pytest.raises(NotAPolicyError, match="no graph"):
        read_saved_model(b"\x08\x01")


@pytest.mark.slow
def test_damage_leaves_nothing_behind(tmp_path: Path) -> None:
    content, out = saved({"serving_default": ("action",)}), tmp_path / "out"
    file = tmp_path / "model/saved_model.pb"
    file.parent.mkdir()
    for position in range(3, len(content), max(len(content) // 80, 1)):
        for damaged in (
            content[:position],
            content[:position] + bytes([content[position] ^ 0xAA]) + content[position + 1 :],
        ):
            file.write_bytes(damaged)
            try:
                list(export([file.parent], ExportOptions(out, verify="none")))
            except ExportModelError as error:
                assert error.exit_status == 2
            assert not out.exists() or {p.name for p in out.iterdir()} <= {"model"}


def test_a_frozen_graph_and_its_saved_model_are_one() -> None:
    base = read_graph(fixture("recurrent.bytes").read_bytes())
    made, _ = exposed(base, {}, {"action": "action:0", "recurrent_out": "recurrent_out:0"})
    assert {n.name for n in made.nodes} <= {n.name for n in base.nodes}


def test_parts_of_an_action_stand_side_by_side() -> None:
    """TF-Agents' PolicySaver calls them ``action/0`` or ``action/jump``: numbers are one action, classes another."""
    base = Graph(
        (
            *graph("a", "b").nodes,
            *(
                Node(f"c{i}", "ArgMax", (name, "one_axis"), {"output_type": np.dtype("i4")}, origin=f"c{i}:0")
                for i, name in enumerate("ab")
            ),
        )
    )
    base = Graph((*base.nodes[:-2], Node("one_axis", "Const", value=np.array(1, np.int32)), *base.nodes[-2:]))
    rows = TensorShape((None,))

    def made(outputs: dict[str, TensorInfo]) -> tuple[Graph, SourceFacts]:
        return with_facts(base, ModelSignature({"x": TensorInfo("x:0", F32, TensorShape((None, 2)))}, outputs))

    class_of = {f"action/{n}": TensorInfo(f"c{i}:0", np.dtype("i4"), rows) for i, n in ((0, "10"), (1, "9"))}
    joined, facts = made(class_of)
    found = run_graph(joined, {"x": np.array([[1, -2], [0, 3]], np.float32)}, ["discrete_actions"])["discrete_actions"]
    np.testing.assert_array_equal(found, [[0, 0], [1, 1]])
    assert [facts.outputs, facts.notes] == [
        {"discrete_actions": Role.ACTION},
        ("discrete_actions is action/9, action/10, in this order",),
    ]
    numbers = {"action/move": TensorInfo("b:0", F32, TensorShape((None, 2)))}
    hybrid, facts = made({**numbers, "action/jump": class_of["action/9"]})
    assert facts.outputs == {"discrete_actions": Role.ACTION, "continuous_actions": Role.ACTION}
    assert (hybrid["continuous_actions"].origin, hybrid["discrete_actions"].origin) == ("b:0", "c1:0")


def test_parts_of_several_kinds_are_joined_beside_a_node_of_that_name() -> None:
    """onnxruntime joins one dtype only; and the graph may have called something ``discrete_actions`` itself."""
    x, rows = TensorShape((None, 2)), TensorShape((None,))
    nodes = [Node("x", "Placeholder", attrs={"dtype": F32, "shape": x}), Node("discrete_actions", "Neg", ("x",))]
    nodes += [Node("axis", "Const", value=np.array(1, np.int32))]
    kinds = {"long": np.dtype("i8"), "short": np.dtype("i4")}
    nodes += [Node(n, "ArgMax", ("discrete_actions", "axis"), {"output_type": kind}) for n, kind in kinds.items()]
    parts = {f"action/{i}": TensorInfo(f"{n}:0", kinds[n], rows) for i, n in enumerate(kinds)}
    joined, _ = with_facts(Graph(tuple(nodes)), ModelSignature({"x": TensorInfo("x:0", F32, x)}, parts))
    assert joined["discrete_actions"].op == "ConcatV2"
    assert {infer_types(joined)[r].dtype for r in joined["discrete_actions"].inputs[:-1]} == {np.dtype("i8")}
    found = run_graph(joined, {"x": np.array([[1, -2], [0, 3]], np.float32)}, ["discrete_actions"])["discrete_actions"]
    np.testing.assert_array_equal(found, [[1, 1], [0, 0]])


def test_an_input_of_which_only_the_length_is_read_is_none() -> None:
    """TF-Agents' collect policies count ``step_type``; what a recurrent one looks at stays."""
    message = graph_def(
        [
            *continuous_policy(),
            *(tf_node(name, "Placeholder", dtype=np.int32) for name in ("step", "looked_at")),
            tf_node("same", "Identity", "step"),
            tf_node("count", "Shape", "same", T=np.int32, out_type=np.int32),
            constant("zero", 0.0),
            tf_node("zeros", "Fill", "count", "zero"),
            tf_node("length", "Shape", "looked_at", T=np.int32, out_type=np.int32),
        ]
    )
    row = TensorShape((None,))
    inputs = {
        "0/observation": TensorInfo("vector_observation:0", F32, TensorShape((None, 3))),
        "0/step_type": TensorInfo("step:0", np.dtype("i4"), row),
        "0/other": TensorInfo("looked_at:0", np.dtype("i4"), row),
    }
    outputs = {"action": TensorInfo("action:0"), "zeros": TensorInfo("zeros:0"), "other": TensorInfo("looked_at:0")}
    left = without_counted(message, ModelSignature(inputs, outputs))
    assert sorted(left.inputs) == ["0/observation", "0/other"]
    made = normalise(from_graph_def(message).prune(["zeros"]))
    zeros = run_graph(made, {"vector_observation": np.ones((5, 3), np.float32)}, ["zeros"])["zeros"]
    assert zeros.shape == (5,)
