"""Snippets in Python: onnxruntime, TensorFlow, ``export_model.load``; and the pieces that TF Serving's use."""

from __future__ import annotations

from msgspec.structs import replace

from export_model.converters.formats.registry import ONNX, SAVED_MODEL
from export_model.exporter.snippets.contract import (
    ODDS,
    STEPS,
    SnippetBundle,
    action_meaning,
    agent_text,
    example_shape,
    fill_template,
    is_drawn_inside,
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
    inside = any(is_drawn_inside(bundle, head) for head in bundle.heads)
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
        lines += [f"# {text}" for text in action_meaning(bundle, head, "policy.agent()")]
    lines.append(f"print({', '.join(f'decision.{kind}' for kind in bundle.kinds)})")
    return fill_template(
        "load_policy.py",
        path=string_literal(bundle.folder.as_posix()),
        says=agent_text(bundle),
        how="" if inside else "deterministic=True",
        play=loop_text(bundle, lines),
    )


def play(bundle: SnippetBundle, run: list[str], *, narrow: bool = False) -> str:
    """From feeds to actions by ``run``, which makes ``outputs`` (name → array) of ``feeds``.

    ``narrow``: what is int64 in the contract is int32 in the file.
    """
    if narrow:
        inputs = tuple(replace(s, dtype="int32") if s.dtype == "int64" else s for s in bundle.signature.inputs)
        bundle = replace(bundle, signature=replace(bundle.signature, inputs=inputs))
    before = bundle.beginnings("{} = {}  # {}", array)
    previous = bundle.previous
    lines = ["feeds = {"]
    for spec in bundle.signature.inputs:
        lines += _entry(bundle, spec, bundle.kept_variables.get(spec.name) or array(spec))
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


def _action(bundle: SnippetBundle, variable: str, head: TensorSpec) -> list[str]:
    plain = bundle.plain(head)
    lines = [f"# {text}" for text in action_meaning(bundle, head)]
    output = f"outputs[{string_literal(plain.name)}]"
    if plain.role not in ODDS:
        return [*lines, f"{variable} = {output}"]
    ends = [sum(bundle.signature.branches[: i + 1]) for i in range(len(bundle.signature.branches) - 1)]
    return [
        *lines,
        f"branches = np.split({output}, {ends}, axis=1)",
        f"{variable} = np.stack([b.argmax(axis=1) for b in branches], axis=1)",
    ]


def _shape(shape: tuple[int, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def _dtype(spec: TensorSpec) -> str:
    return "np.bool_" if spec.dtype == "bool" else f"np.{spec.dtype}"
