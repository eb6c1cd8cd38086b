"""Actions that are drawn in ways of their own: what has no chance in it, or a refusal."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import SignatureError
from export_model.signatures.roles import Role
from tests.graph.making import const, graph, node, placeholder

STATE = np.array([[0.5, -1.0, 2.0], [0.1, 0.2, -0.3]], np.float32)
OBSERVATION = placeholder("vector_observation", (None, 3))


def drawn(sampler: str) -> list[Node]:
    """``draw``, of the observation's shape."""
    return [OBSERVATION, node("shape", "Shape", OBSERVATION.name), node("draw", sampler, "shape", dtype=np.dtype("f4"))]


def compiled(made: Graph, **options: object) -> Policy:
    (policy,) = compile_graph(made, "p", CompileOptions(**options))  # type: ignore[arg-type]
    return policy


def run(policy: Policy, *outputs: str) -> list[np.ndarray]:
    feeds = {s.name: STATE if s.name == "state" else np.ones_like(STATE) for s in policy.signature.inputs}
    results = run_graph(policy.graph, feeds, outputs)
    return [results[name] for name in outputs]


@pytest.mark.parametrize("sampler", ["RandomStandardNormal", "TruncatedNormal"])
@pytest.mark.parametrize("noise", ["lift", "keep", "zero"])
def test_the_middle_of_a_normal_is_the_action_without_chance(sampler: str, noise: str) -> None:
    made = graph(*drawn(sampler), node("action", "Add", OBSERVATION.name, "draw"))
    policy = compiled(made, noise=noise)
    np.testing.assert_array_equal(run(policy, "deterministic_action")[0], STATE)
    deterministic = compiled(made, deterministic=True)
    np.testing.assert_array_equal(run(deterministic, "action")[0], STATE)


def test_a_uniform_draw_has_no_middle_that_is_no_chance() -> None:
    made = graph(*drawn("RandomUniform"), node("action", "Add", OBSERVATION.name, "draw"))
    with pytest.raises(SignatureError, match=r"deterministic_action .*'draw' \(RandomUniform\)"):
        compiled(made)


def test_the_tensor_before_the_draw_can_be_the_action() -> None:
    made = graph(*drawn("RandomUniform"), node("mean", "Tanh", OBSERVATION.name), node("action", "Add", "mean", "draw"))
    policy = compiled(made, outputs={"mean": Role.ACTION})
    np.testing.assert_allclose(run(policy, "action")[0], np.tanh(STATE), rtol=1e-6)


def test_a_tensor_that_is_said_to_be_without_chance_and_is_drawn_is_refused() -> None:
    made = graph(
        *drawn("RandomUniform"),
        node("deterministic_action", "Add", OBSERVATION.name, "draw"),
        node("action", "Tanh", "deterministic_action"),
    )
    with pytest.raises(SignatureError, match="another one in every run"):
        compiled(made)


def test_an_argmax_of_drawn_scores_is_no_action_without_chance() -> None:
    made = graph(
        *drawn("RandomUniform"),
        node("noisy", "Mul", OBSERVATION.name, "draw"),
        const("axis", 1),
        node("action", "ArgMax", "noisy", "axis"),
    )
    with pytest.raises(SignatureError, match="another one in every run"):
        compiled(made)


@pytest.mark.parametrize("form", ["Sub", "Add"])
def test_a_gumbel_draw_is_a_draw(form: str) -> None:
    """OpenAI Baselines draws so: argmax(logits − log(−log(u)))."""
    tail = [node("gumbel", "Neg", "outer")] if form == "Add" else []
    made = graph(
        *drawn("RandomUniform"),
        node("inner", "Log", "draw"),
        node("negative", "Neg", "inner"),
        node("outer", "Log", "negative"),
        *tail,
        node("scores", form, OBSERVATION.name, tail[0].name if tail else "outer"),
        const("axis", 1),
        node("action", "ArgMax", "scores", "axis"),
    )
    policy = compiled(made)
    roles = {s.name: s.role for s in policy.signature.outputs}
    assert roles == {
        "action": Role.SAMPLED, "deterministic_action": Role.DETERMINISTIC, "action_log_probs": Role.LOG_PROBS,
    }  # fmt: skip
    best, scores = run(policy, "deterministic_action", "action_log_probs")
    np.testing.assert_array_equal(best, STATE.argmax(axis=1)[:, None])
    np.testing.assert_allclose(np.exp(scores).sum(axis=1), 1, rtol=1e-6)
    assert policy.signature.branches == (3,)
    draws = np.concatenate([run(policy, "action")[0][:1] for _ in range(400)])
    frequencies = np.bincount(draws, minlength=3) / len(draws)
    np.testing.assert_allclose(frequencies, np.exp(scores[0]), atol=0.11)


@pytest.mark.parametrize(("most", "meaning"), [(2, Role.SAMPLED), (1, None)])
def test_a_class_held_within_bounds_that_it_cannot_leave_is_a_draw(most: int, meaning: Role | None) -> None:
    """TF-Agents clips what it draws to the action's space; a bound that a class is beyond makes another action."""
    made = graph(
        *(OBSERVATION, const("one", 1), const("most", most), const("least", 0)),
        node("draw", "Multinomial", OBSERVATION.name, "one", output_dtype=np.dtype("i4")),
        node("below", "Minimum", "draw", "most"),
        node("action", "Maximum", "below", "least"),
    )
    if meaning is None:
        with pytest.raises(SignatureError, match="another one in every run"):
            compiled(made)
        return
    policy = compiled(made)
    assert policy.signature.output("action").role is meaning
    np.testing.assert_array_equal(run(policy, "deterministic_action")[0][:, 0], STATE.argmax(1))


def test_clips_one_after_the_other_are_no_riddle() -> None:
    """Each asked what lies behind it anew: thirty took hours."""
    made = graph(
        *(OBSERVATION, const("axis", 1), const("most", 2)),
        node("clip0", "ArgMax", OBSERVATION.name, "axis", output_type=np.dtype("i4")),
        *(node(f"clip{i}", "Minimum", f"clip{i - 1}", "most") for i in range(1, 60)),
        node("action", "Identity", "clip59"),
    )
    np.testing.assert_array_equal(run(compiled(made), "action")[0].ravel(), STATE.argmax(axis=1))


def epsilon_greedy(exploring: str, threshold: float) -> list[Node]:
    """``action`` [B]: where a uniform number is less than the threshold ``exploring``, else the largest of three."""
    exploration = {
        "equal": [
            node("any", "RandomUniformInt", "rows", "zero", "three", Tout=np.dtype("i4")),
        ],
        "odds": [
            node("drawn", "Multinomial", OBSERVATION.name, "one", output_dtype=np.dtype("i4")),
            node("any", "Reshape", "drawn", "flat"),
        ],
    }[exploring]
    return [
        OBSERVATION,
        *(const(k, v) for k, v in {"zero": 0, "one": 1, "three": 3, "flat": [-1]}.items()),
        *(const(k, [v]) for k, v in {"begin": 0, "end": 1}.items()),
        const("epsilon", threshold, np.float32),
        node("whole", "Shape", OBSERVATION.name),
        node("rows", "StridedSlice", "whole", "begin", "end", "end"),
        *exploration,
        node("best", "ArgMax", OBSERVATION.name, "one", output_type=np.dtype("i4")),
        node("u", "RandomUniform", "rows", dtype=np.dtype("f4")),
        node("exploits", "GreaterEqual", "u", "epsilon"),
        node("action", "Select", "exploits", "best", "any"),
    ]


@pytest.mark.parametrize("exploring", ["equal", "odds"])
def test_an_epsilon_greedy_action_is_one_draw_of_the_same_odds(exploring: str) -> None:
    policy = compiled(graph(*epsilon_greedy(exploring, 0.3)))
    assert {s.role for s in policy.signature.outputs} == {Role.SAMPLED, Role.DETERMINISTIC, Role.LOG_PROBS}
    odds = np.exp(STATE) / np.exp(STATE).sum(axis=1, keepdims=True) if exploring == "odds" else np.full((2, 3), 1 / 3)
    wanted = 0.3 * odds + 0.7 * np.eye(3)[STATE.argmax(axis=1)]
    log_probs, likeliest = run(policy, "action_log_probs", "deterministic_action")
    np.testing.assert_allclose(np.exp(log_probs), wanted, rtol=1e-5)
    np.testing.assert_array_equal(likeliest[:, 0], STATE.argmax(axis=1))
    many = run_graph(policy.graph, {"state": np.repeat(STATE[:1], 6000, axis=0)}, ["action"])["action"]
    np.testing.assert_allclose(np.bincount(many.reshape(-1), minlength=3) / 6000, wanted[0], atol=0.05)


def test_two_choices_that_share_what_decides_are_not_drawn_apart() -> None:
    """Drawn at once each would have its own draw, where the source explores with both or with none."""
    made = [
        *(n for n in epsilon_greedy("equal", 0.3) if n.name != "action"),
        node("first", "Select", "exploits", "best", "any"),
        node("second", "Select", "exploits", "any", "best"),
        node("action", "Pack", "first", "second", axis=1),
    ]
    with pytest.raises(SignatureError, match=r"deterministic_action would be another one in every run"):
        compiled(graph(*made))
