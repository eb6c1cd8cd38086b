"""What to feed the inputs of a policy, and what its outputs mean, in words: by their roles."""

from __future__ import annotations

from export_model.signatures.ids import bounds_text
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

_FEED = {
    Role.VECTOR: "the agent's vector observation, as the environment gives it{normalised}",
    Role.VISUAL: "camera image, {layout}, colours {colours}, first row at the top",
    Role.ENTITIES: "variable-length observation",
    Role.NOISE: "N(0, 1) draws, or zeros for the deterministic action",
    Role.MASKS: "1 = allowed, 0 = forbidden; branches side by side",
    Role.PREV_ACTION: "the action of the step before, an integer per branch",
    Role.MEMORY_IN: "recurrent_out of the step before; zeros at the start of an episode",
    Role.PARAMETER: "not known to ML-Agents; feed it, or fix it with --set NAME=VALUE",
}
OUTPUT_MEANINGS = {
    Role.CONTINUOUS: "continuous action",
    Role.SAMPLED: "action drawn inside the graph, an integer per branch",
    Role.LOG_PROBS: "log-probabilities per branch; draw from them, or take the argmax",
    Role.PROBS: "probabilities per branch",
    Role.DETERMINISTIC: "deterministic action",
    Role.ACTION_PROBS: "the trainer's action_probs (its meaning changed from version to version)",
    Role.VALUE: "the critic's value",
    Role.Q_VALUES: "a value of each action (the action is the largest)",
    Role.MEMORY_OUT: "memory for the next step",
    Role.OTHER: "another output",
}


def feed_text(spec: TensorSpec, signature: PolicySignature) -> str:
    """Return what an input of a policy takes."""
    known, preprocess = spec.distribution or {}, signature.preprocess.get(spec.name, {})
    if spec.role is Role.VECTOR and known.get("kind") == "integer":
        return f"{'a history or a board' if len(spec.shape) > 2 else 'the discrete state'}, {bounds_text(spec)}"
    if spec.role is Role.VECTOR and len(spec.shape) > 2:
        return "numbers along several axes (a history, a board), as the environment gives them"
    own = preprocess.get("range") == [0, 255]
    colours = "from 0 to 255 (bytes as they are)" if own else "from 0 to 1 (divide bytes by 255)"
    return _FEED.get(spec.role, spec.role.value).format(
        layout=preprocess.get("layout", "NHWC"),
        colours=colours,
        normalised=" (normalised inside the policy)" if "std" in known else "",
    )
