"""Snippets in Python: onnxruntime, TensorFlow, ``export_model.load``; and the pieces that TF Serving's use."""

from __future__ import annotations

from export_model.converters.formats.registry import ONNX, SAVED_MODEL
from export_model.exporter.snippets.contract import (
    ODDS,
    STEPS,
    SnippetBundle,
    action_meaning,
    example_shape,
    fill_template,
    meaning,
    string_literal,
)
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec


def onnxruntime(bundle: SnippetBundle) -> str:
    """The ONNX in onnxruntime."""
    run = "dict(zip(names, session.run(names, feeds)))"
    return fill_template(
        "onnxruntime.py",
        path=string_literal(bundle.path(ONNX.main_of(bundle.name))),
        play=play(bundle, [f"outputs = {run}"]),
    )


def saved_model(bundle: SnippetBundle) -> str:
    """The SavedModel in TensorFlow."""
    run = [
        "answer = policy(**{name: tf.constant(value) for name, value in feeds.items()})",
        "outputs = {name: tensor.numpy() for name, tensor in answer.items()}",
    ]
    return fill_template(
        "saved_model.py", path=string_literal(bundle.path(SAVED_MODEL.main_of(bundle.name))), play=play(bundle, run)
    )


def load_policy(bundle: SnippetBundle) -> str:
    """The bundle by this tool's own package."""
    masks = next((s for s in bundle.signature.inputs if s.role is Role.MASKS), None)
    parameters = [s for s in bundle.signature.inputs if s.role is Role.PARAMETER]
    lines = ["decision = agents.decide(", "    {"]
    for spec in bundle.signature.observations:
        lines += [f"    {line}" for line in _entry(bundle, spec, array(spec))]
    lines.append("    },")
    if masks is not None:
        lines += [f"    # {text}" for text in meaning(bundle, masks)]
        lines.append(f"    masks={array(masks)},")
    if parameters:
        lines.append("    parameters={")
        for spec in parameters:
            lines += [f"    {line}" for line in _entry(bundle, spec, array(spec))]
        lines.append("    },")
    lines.append(")")
    for head in bundle.heads:
        lines += [f"# {text}" for text in action_meaning(bundle, head)]
    lines.append(f"print({', '.join(f'decision.{kind}' for kind in bundle.kinds)})")
    return fill_template("load_policy.py", path=string_literal(bundle.folder.as_posix()), play=loop_text(bundle, lines))


def play(bundle: SnippetBundle, run: list[str]) -> str:
    """From feeds to actions by ``run``, which makes ``outputs`` (name → array) of ``feeds``."""
    before = ["rng = np.random.default_rng()"] if _draws(bundle) else []
    before += bundle.beginnings("{} = {}  # {}", array)
    previous = bundle.previous
    lines = ["feeds = {"]
    for spec in bundle.signature.inputs:
        lines += _entry(bundle, spec, _feed_expression(bundle, spec))
    lines += ["}", *run]
    for variable, head in zip(bundle.variables, bundle.heads, strict=True):
        lines += _action(bundle, variable, head)
    lines += [f"{variable} = outputs[{string_literal(given)}]" for _, given, variable in bundle.memories]
    if previous is not None:
        shape = ".reshape(-1)" if len(previous.shape) == 1 else ""
        lines.append(f"previous = {bundle.discrete_variable}{shape}.astype({_dtype(previous)})")
    lines.append(f"print({', '.join(bundle.variables)})")
    return "\n".join([*before, loop_text(bundle, lines)])


def loop_text(bundle: SnippetBundle, lines: list[str]) -> str:
    """``lines`` as they are, or in a loop of a few steps where the policy remembers."""
    if not bundle.remembers:
        return "\n".join([*lines, ""])
    return "\n".join([f"for step in range({STEPS}):", *(f"    {line}" for line in lines), ""])


def array(spec: TensorSpec) -> str:
    """An example of one agent's input: all actions allowed, all else zero."""
    maker = "ones" if spec.role is Role.MASKS else "zeros"
    return f"np.{maker}({_shape(example_shape(spec))}, {_dtype(spec)})"


def _entry(bundle: SnippetBundle, spec: TensorSpec, value: str) -> list[str]:
    return [*(f"    # {text}" for text in meaning(bundle, spec)), f"    {string_literal(spec.name)}: {value},"]


def _feed_expression(bundle: SnippetBundle, spec: TensorSpec) -> str:
    if spec.role is Role.NOISE:
        return f"rng.standard_normal({_shape(example_shape(spec))}, {_dtype(spec)})"
    return bundle.kept_variables.get(spec.name) or array(spec)


def _draws(bundle: SnippetBundle) -> bool:
    return bool(bundle.signature.noise) or any(h.role in ODDS for h in bundle.heads)


def _action(bundle: SnippetBundle, variable: str, head: TensorSpec) -> list[str]:
    plain = bundle.plain(head)
    lines = [f"# {text}" for text in action_meaning(bundle, head)]
    if plain != head:
        lines.append(f"# deterministic: outputs[{string_literal(plain.name)}]")
    output = f"outputs[{string_literal(head.name)}]"
    if head.role not in ODDS:
        return [*lines, f"{variable} = {output}"]
    scores = output if head.role is Role.LOG_PROBS else f"np.log({output})"
    ends = [sum(bundle.signature.branches[: i + 1]) for i in range(len(bundle.signature.branches) - 1)]
    return [
        *lines,
        f"branches = np.split({scores}, {ends}, axis=1)  # log-probabilities",
        "# a draw from each branch: the largest of log-probability + Gumbel noise",
        f"{variable} = np.stack([(b + rng.gumbel(size=b.shape)).argmax(axis=1) for b in branches], axis=1)",
    ]


def _shape(shape: tuple[int, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def _dtype(spec: TensorSpec) -> str:
    return "np.bool_" if spec.dtype == "bool" else f"np.{spec.dtype}"
