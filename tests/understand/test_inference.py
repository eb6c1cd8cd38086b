"""The signature read off a graph: brains, outputs, what each placeholder is for, what the action means."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.policy.brains import find_brains
from export_model.converters.policy.inputs import classify_inputs, placeholder_rank, role_by_name
from export_model.signatures.errors import NotAPolicyError, SignatureError, UsageError
from export_model.signatures.roles import Role
from tests.signatures.nodes import FLOAT, INT, Dims, constant, graph, op, placeholder


def outputs(g: Graph, wanted: dict[str, Role] | None = None) -> list[dict[str, tuple[Role, str]]]:
    return [{base: (role, tensor) for base, role, tensor in brain.outputs} for brain in find_brains(g, wanted)]


def roles(g: Graph, wanted: dict[str, Role] | None = None) -> dict[str, Role]:
    (brain,) = find_brains(g)
    return classify_inputs(g, brain, wanted)


def policy(*inputs: Node, scope: str = "") -> Graph:
    """A graph whose action depends on all inputs."""
    total = op(f"{scope}sum", "AddN", *(n.name for n in inputs))
    return graph(*inputs, total, op(f"{scope}action", "Tanh", f"{scope}sum"))


# ------------------------------------------------------------------ names of every generation


@pytest.mark.parametrize(
    ("name", "dims", "dtype", "role"),
    [
        # 0.1, 0.2
        ("state", (None, 8), FLOAT, Role.VECTOR),
        ("state", (None, 1), INT, Role.VECTOR),
        ("observation_0", (None, 40, 40, 3), FLOAT, Role.VISUAL),
        ("observation", (None, 40, 40, 3), FLOAT, Role.VISUAL),
        ("observation_1", None, FLOAT, Role.VISUAL),
        ("epsilon", (None, 2), FLOAT, Role.NOISE),
        ("batch_size", None, INT, Role.BATCH_SIZE),
        # 0.3 to 0.5
        ("vector_observation", (None, 8), FLOAT, Role.VECTOR),
        ("vector_observation", (None, 1), INT, Role.VECTOR),
        ("visual_observation_0", (None, 84, 84, 3), FLOAT, Role.VISUAL),
        ("recurrent_in", (None, 32), FLOAT, Role.MEMORY_IN),
        ("sequence_length", None, INT, Role.SEQUENCE_LENGTH),
        ("sequence_length", (), INT, Role.SEQUENCE_LENGTH),
        ("prev_action", (None,), INT, Role.PREV_ACTION),
        ("prev_action", (None, 2), INT, Role.PREV_ACTION),
        ("action_masks", (None, 5), FLOAT, Role.MASKS),
        # 0.10 to 0.23
        ("sequence_length_1", None, INT, Role.SEQUENCE_LENGTH),
        ("visual_observation_12", (None, 84, 84, 1), FLOAT, Role.VISUAL),
        # torch
        ("obs_0", (None, 8), FLOAT, Role.VECTOR),
        ("obs_0", (None, 3, 84, 84), FLOAT, Role.VISUAL),
        ("obs_1", (None, 20, 4), FLOAT, Role.ENTITIES),
        ("memories", (None, 1, 64), FLOAT, Role.MEMORY_IN),
    ],
)
def test_names_of_every_generation_have_their_roles(name: str, dims: Dims, dtype: np.dtype, role: Role) -> None:
    assert role_by_name(name, placeholder(name, dims, dtype)) is role


@pytest.mark.parametrize(
    ("name", "dims", "dtype"),
    [
        ("state", (None, 8, 8), FLOAT),
        ("observation_0", (None, 40), FLOAT),
        ("observation_0", (None, 4, 4, 3), INT),
        ("prev_action", (None, 2), FLOAT),
        ("batch_size", (), FLOAT),
        ("sequence_length", (None, 2), INT),
        ("action_masks", (None, 2, 2), FLOAT),
        ("my_state", (None, 8), FLOAT),
        ("states", (None, 8), FLOAT),
        ("Epsilon", (None, 8), FLOAT),
    ],
)
def test_a_name_that_rank_or_dtype_contradict_says_nothing(name: str, dims: Dims, dtype: np.dtype) -> None:
    assert role_by_name(name, placeholder(name, dims, dtype)) is None


def test_the_rank_of_a_placeholder_may_be_unknown() -> None:
    assert placeholder_rank(placeholder("x", None)) is None
    assert placeholder_rank(Node("x", "Placeholder", (), {"dtype": FLOAT})) is None
    assert placeholder_rank(placeholder("x", ())) == 0


# ------------------------------------------------------------------ brains and outputs


def test_a_brain_has_the_outputs_that_are_called_so() -> None:
    g = graph(
        placeholder("vector_observation"),
        op("action", "Tanh", "vector_observation"),
        op("value_estimate", "Neg", "vector_observation"),
        op("action_probs", "Exp", "vector_observation"),
        op("recurrent_out", "Abs", "vector_observation"),
        op("something", "Abs", "vector_observation"),
        constant("memory_size", 7),
        constant("version_number", np.array(2, np.int32)),
    )
    (brain,) = find_brains(g)
    assert [(base, role) for base, role, _ in brain.outputs] == [
        ("action", Role.ACTION),
        ("value_estimate", Role.VALUE),
        ("action_probs", Role.ACTION_PROBS),
        ("recurrent_out", Role.MEMORY_OUT),
    ]
    assert (brain.scope, brain.label) == ("", "")
    assert dict(brain.constants) == {"version_number": 2, "memory_size": 7}
    assert brain.roots == ("action", "value_estimate", "action_probs", "recurrent_out")


def test_an_output_that_depends_on_no_input_is_a_constant() -> None:
    g = graph(
        placeholder("state"), op("action", "Tanh", "state"), constant("k", 1.0), op("value_estimate", "Identity", "k")
    )
    assert outputs(g) == [{"action": (Role.ACTION, "action")}]


@pytest.mark.parametrize(
    ("value", "expected"),
    [(np.array(3), 3), (np.array([2.0], np.float32), 2), (np.array(0.5), 0.5), (np.array(-1, np.int64), -1)],
)
def test_constants_are_numbers(value: np.ndarray, expected: float) -> None:
    g = graph(placeholder("state"), op("action", "Tanh", "state"), constant("version_number", value))
    assert dict(find_brains(g)[0].constants) == {"version_number": expected}


@pytest.mark.parametrize(
    "value", [np.array([1, 2]), np.array(np.nan), np.array(-np.inf), np.array(b"two"), np.array(True)]
)
def test_what_is_no_number_is_no_constant(value: np.ndarray) -> None:
    g = graph(placeholder("state"), op("action", "Tanh", "state"), constant("version_number", value))
    assert dict(find_brains(g)[0].constants) == {}


def test_each_scope_with_an_action_is_a_brain() -> None:
    g = Graph(
        tuple(
            node
            for scope in ("Goalie-Brain/", "Striker-Brain/")
            for node in (
                placeholder(f"{scope}vector_observation"),
                op(f"{scope}action", "Tanh", f"{scope}vector_observation"),
                op(f"{scope}value_estimate", "Neg", f"{scope}vector_observation"),
                constant(f"{scope}memory_size", len(scope)),
            )
        )
    )
    goalie, striker = find_brains(g)
    assert (goalie.label, striker.label) == ("Goalie-Brain", "Striker-Brain")
    assert [t for _, _, t in striker.outputs] == ["Striker-Brain/action", "Striker-Brain/value_estimate"]
    assert dict(goalie.constants) == {"memory_size": 13}
    assert classify_inputs(g, striker) == {"Striker-Brain/vector_observation": Role.VECTOR}


def test_an_action_inside_the_policy_is_no_brain_of_its_own() -> None:
    """SAC has ``policy/action`` and the like beside the exported ``action``."""
    g = graph(
        placeholder("vector_observation"),
        op("policy/action", "Tanh", "vector_observation"),
        op("critic/value/action", "Neg", "vector_observation"),
        op("action", "Identity", "policy/action"),
    )
    assert [brain.scope for brain in find_brains(g)] == [""]


def test_hybrid_actions_are_two_heads() -> None:
    g = graph(
        placeholder("obs_0"),
        op("continuous_actions", "Tanh", "obs_0"),
        op("discrete_actions", "Neg", "obs_0"),
        op("deterministic_discrete_actions", "Abs", "obs_0"),
    )
    (brain,) = find_brains(g)
    assert [h.name for h in brain.heads] == ["continuous_actions", "discrete_actions"]
    assert [h.deterministic for h in brain.heads] == [
        "deterministic_continuous_actions",
        "deterministic_discrete_actions",
    ]
    assert brain.canonical["deterministic_discrete_actions"] == "deterministic_discrete_actions"


def test_an_action_by_kind_alone_is_the_action() -> None:
    g = graph(placeholder("obs_0"), op("continuous_actions", "Tanh", "obs_0"))
    (brain,) = find_brains(g)
    assert [(h.base, h.name) for h in brain.heads] == [("continuous_actions", "action")]
    assert brain.canonical == {"continuous_actions": "action"}


# ------------------------------------------------------------------ own models


def test_the_one_tensor_that_nothing_reads_is_the_action() -> None:
    g = graph(placeholder("obs"), op("net/dense", "Tanh", "obs"))
    assert outputs(g) == [{"dense": (Role.ACTION, "net/dense")}]


@pytest.mark.parametrize("name", ["policy_head", "pi", "actor/pi", "my_action"])
def test_of_several_the_one_that_sounds_like_an_action_is_taken(name: str) -> None:
    g = graph(placeholder("obs"), op(name, "Tanh", "obs"), op("critic", "Neg", "obs"))
    assert [tensor for _, tensor in outputs(g)[0].values()] == [name]


def test_a_tensor_that_only_hands_an_input_on_is_not_the_action() -> None:
    handed = op("state_outs", "Identity", "state_ins")
    given = graph(placeholder("obs", (None, 3)), placeholder("state_ins", (None,)), op("y", "Tanh", "obs"), handed)
    (brain,) = find_brains(given)
    assert brain.outputs == (("y", Role.ACTION, "y"),)
    assert brain.left_out == ("state_outs",)


def test_several_candidates_are_listed_with_the_flag_that_decides() -> None:
    g = graph(placeholder("obs"), op("left", "Tanh", "obs"), op("right", "Neg", "obs"))
    with pytest.raises(SignatureError) as caught:
        find_brains(g)
    assert "left (Tanh), right (Neg)" in str(caught.value)
    assert "--output NAME=action" in str(caught.value)
    many = graph(placeholder("obs"), *(op(f"out{i}", "Neg", "obs") for i in range(20)))
    with pytest.raises(SignatureError, match=r"out7 \(Neg\) …"):
        find_brains(many)


@pytest.mark.parametrize("nodes", [[constant("a", 1.0)], [placeholder("obs")], [placeholder("action")]])
def test_a_graph_that_computes_nothing_from_an_input_is_no_policy(nodes: list[Node]) -> None:
    with pytest.raises(NotAPolicyError, match="--output NAME=action"):
        find_brains(graph(*nodes))


def test_outputs_that_the_format_declares_go_before_names() -> None:
    g = graph(
        placeholder("obs"),
        op("net/action", "Tanh", "obs"),
        op("left", "Neg", "net/action"),
        op("right", "Abs", "net/action"),
    )
    (brain,) = find_brains(g, declared={"left": Role.ACTION, "right": None})
    assert brain.outputs == (("left", Role.ACTION, "left"), ("right", Role.OTHER, "right"))
    assert brain.left_out == ()
    (only,) = find_brains(g, declared={"left": None})
    assert only.outputs == (("left", Role.ACTION, "left"),)
    with pytest.raises(SignatureError, match=r"left \(Neg\), right \(Abs\)"):
        find_brains(g, declared={"left": None, "right": None})


def test_outputs_can_be_named() -> None:
    g = graph(placeholder("obs"), op("net/left", "Tanh", "obs"), op("net/right", "Neg", "obs"))
    assert outputs(g, {"net/left": Role.ACTION, "net/right:0": Role.VALUE}) == [
        {"left": (Role.ACTION, "net/left"), "right": (Role.VALUE, "net/right")}
    ]


def test_naming_one_output_leaves_the_rest_where_it_always_is() -> None:
    g = graph(placeholder("state"), op("action", "Tanh", "state"), op("critic", "Neg", "state"))
    assert outputs(g, {"critic": Role.VALUE}) == [{"critic": (Role.VALUE, "critic"), "action": (Role.ACTION, "action")}]


def test_naming_an_output_of_one_brain_leaves_the_other_as_it_is() -> None:
    g = Graph(
        tuple(
            node
            for scope in ("A/", "B/")
            for node in (
                placeholder(f"{scope}state"),
                op(f"{scope}action", "Tanh", f"{scope}state"),
                op(f"{scope}critic", "Neg", f"{scope}state"),
            )
        )
    )
    assert outputs(g, {"B/critic": Role.VALUE}) == [
        {"action": (Role.ACTION, "A/action")},
        {"critic": (Role.VALUE, "B/critic"), "action": (Role.ACTION, "B/action")},
    ]
    (chosen,) = find_brains(g, {"B/action": Role.ACTION})
    assert (chosen.label, chosen.outputs) == ("B", (("action", Role.ACTION, "B/action"),))
    a, b = find_brains(g)
    assert classify_inputs(g, a, {"B/state": Role.PARAMETER}) == {"A/state": Role.VECTOR}
    with pytest.raises(SignatureError, match="B/state"):
        classify_inputs(g, b, {"B/state": Role.PARAMETER})


def test_an_output_that_is_not_there_is_refused_with_what_is_near() -> None:
    g = graph(placeholder("obs"), op("left", "Tanh", "obs"))
    with pytest.raises(UsageError, match="close to it: left"):
        find_brains(g, {"lefd": Role.ACTION})
    with pytest.raises(UsageError, match="not an output's role"):
        find_brains(g, {"left": Role.VECTOR})


# ------------------------------------------------------------------ inputs by structure


def test_only_what_is_upstream_of_the_outputs_is_an_input() -> None:
    g = graph(placeholder("state"), placeholder("learning_rate", ()), op("action", "Tanh", "state"))
    assert roles(g) == {"state": Role.VECTOR}


def test_an_unknown_name_of_a_matrix_of_floats_is_the_observation() -> None:
    assert roles(policy(placeholder("what_it_sees"))) == {"what_it_sees": Role.VECTOR}
    assert roles(policy(placeholder("what_it_sees", None))) == {"what_it_sees": Role.VECTOR}


def test_an_unknown_name_of_rank_4_is_an_image() -> None:
    assert roles(policy(placeholder("camera", (None, 8, 8, 3)))) == {"camera": Role.VISUAL}


def test_an_unknown_name_beside_an_observation_is_a_parameter() -> None:
    g = policy(placeholder("vector_observation"), placeholder("speed", (1,)), placeholder("heat"))
    assert roles(g) == {"vector_observation": Role.VECTOR, "speed": Role.PARAMETER, "heat": Role.PARAMETER}


def test_integers_that_become_one_hot_are_a_discrete_state_or_the_previous_action() -> None:
    def hot(*others: Node) -> Graph:
        parts = [placeholder("number", (None, 1), INT), *others]
        return graph(
            *parts,
            op("flat", "Reshape", "number"),
            op("hot", "OneHot", "flat"),
            op("action", "ConcatV2", "hot", *(n.name for n in others)),
        )

    assert roles(hot()) == {"number": Role.VECTOR}
    recurrent = hot(placeholder("vector_observation"), placeholder("recurrent_in", (None, 32)))
    assert roles(recurrent)["number"] is Role.PREV_ACTION
    assert roles(hot(placeholder("vector_observation")))["number"] is Role.PARAMETER


@pytest.mark.parametrize("between", [(), ("Add",), ("AddV2",)])
def test_floats_that_multiply_a_softmax_are_masks(between: tuple[str, ...]) -> None:
    g = graph(
        placeholder("vector_observation"),
        placeholder("allowed", (None, 3)),
        constant("e", 1e-7),
        op("softmax", "Softmax", "vector_observation"),
        *(op("plus", kind, "softmax", "e") for kind in between),
        op("action", "Mul", "plus" if between else "softmax", "allowed"),
    )
    assert roles(g) == {"vector_observation": Role.VECTOR, "allowed": Role.MASKS}


def test_floats_that_multiply_something_else_are_no_masks() -> None:
    g = graph(placeholder("vector_observation"), placeholder("gain"), op("action", "Mul", "vector_observation", "gain"))
    assert roles(g)["gain"] is Role.PARAMETER


def test_a_default_that_nobody_names_is_used() -> None:
    default = Node("keep", "PlaceholderWithDefault", ("k",), {"dtype": FLOAT, "shape": TensorShape(())})
    g = graph(placeholder("state"), constant("k", 1.0), default, op("action", "Mul", "state", "keep"))
    assert roles(g) == {"state": Role.VECTOR}
    assert roles(g, {"keep": Role.PARAMETER}) == {"state": Role.VECTOR, "keep": Role.PARAMETER}


@pytest.mark.parametrize("key", ["Brain/odd", "Brain/odd:0", "odd"])
def test_a_role_can_be_given_by_any_of_the_names(key: str) -> None:
    g = policy(placeholder("Brain/vector_observation"), placeholder("Brain/odd"), scope="Brain/")
    assert roles(g, {key: Role.NOISE})["Brain/odd"] is Role.NOISE


def test_a_role_that_was_given_goes_before_everything() -> None:
    g = policy(placeholder("state"), placeholder("epsilon"))
    assert roles(g, {"state": Role.PARAMETER, "epsilon": Role.VECTOR}) == {
        "state": Role.PARAMETER,
        "epsilon": Role.VECTOR,
    }
    with pytest.raises(SignatureError, match="--input NAME=vector_observation"):
        roles(policy(placeholder("state")), {"state": Role.PARAMETER})


def test_what_the_reader_knows_goes_before_names_and_after_the_user() -> None:
    g = policy(placeholder("a"), placeholder("epsilon"))
    (brain,) = find_brains(g)
    known = {"a": Role.NOISE, "epsilon": Role.VECTOR}
    assert classify_inputs(g, brain, None, known) == known
    assert classify_inputs(g, brain, {"a": Role.PARAMETER}, known)["a"] is Role.PARAMETER


def test_roles_that_cannot_be_are_refused() -> None:
    g = policy(placeholder("state"))
    with pytest.raises(UsageError, match="not an input's role"):
        roles(g, {"state": Role.VALUE})
    with pytest.raises(UsageError, match="close to it: state"):
        roles(g, {"stat": Role.VECTOR})
    with pytest.raises(UsageError, match="its inputs are state"):
        roles(g, {"zzz": Role.VECTOR})


def test_without_an_observation_the_inputs_are_listed_with_their_shapes() -> None:
    g = policy(placeholder("a", (None, 3), INT), placeholder("b", None, INT))
    with pytest.raises(SignatureError) as caught:
        roles(g)
    assert r"a (int32 [?, 3]), b (int32, unknown shape)" in str(caught.value)


# ------------------------------------------------------------------ what comes in front of a policy


def observation_graph(weight: np.ndarray, output: str) -> Graph:
    """A product with a constant, and a sum with an input: what robots' exporters put in front of their policies."""
    kernel = constant("kernel", weight)
    inputs = (placeholder("gyro", (None, len(weight))), placeholder("bias", (None, weight.shape[1])))
    return graph(*inputs, kernel, op("turned", "MatMul", "gyro", "kernel"), op(output, "Add", "turned", "bias"))


@pytest.mark.parametrize("output", ["obs", "observation", "observations", "obs_0"])
def test_an_output_called_an_observation_without_a_trained_weight_is_no_action(output: str) -> None:
    turn = np.eye(4, dtype=np.float32)
    with pytest.raises(NotAPolicyError, match="computes an observation, not an action") as caught:
        outputs(observation_graph(turn, output))
    assert f"--output {output}=action" in str(caught.value)
    assert outputs(observation_graph(turn, output), {output: Role.ACTION})
    trained = np.ones((8, 4), np.float32)
    assert outputs(observation_graph(trained, output)) == [{output: (Role.ACTION, output)}]
    assert outputs(observation_graph(turn, "torques")) == [{"torques": (Role.ACTION, "torques")}]
