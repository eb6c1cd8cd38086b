"""Snippets in JavaScript: policy.mjs, plain TensorFlow.js and onnxruntime-web, each a page of its own, or for Node.

A page lies beside the bundle's folder and takes its runtime from ``node_modules`` there: no network is needed.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from exporter.snippets.contract import (
    STEPS,
    Bundle,
    action_meaning,
    example_shape,
    example_size,
    fill_template,
    meaning,
    string_literal,
)
from signatures.roles import Role
from signatures.spec import TensorSpec

_TFJS = ("@tensorflow/tfjs", "@tensorflow/tfjs/dist/tf.fesm.min.js")
_ORT = ("onnxruntime-web", "onnxruntime-web/dist/ort.wasm.bundle.min.mjs")

#: What holds a tensor's numbers (float16: their bits, as onnxruntime-web takes them).
_ARRAYS = {
    "float16": "Uint16Array",
    "float32": "Float32Array",
    "float64": "Float64Array",
    "bool": "Uint8Array",
    "int8": "Int8Array",
    "int16": "Int16Array",
    "int32": "Int32Array",
    "int64": "BigInt64Array",
    "uint8": "Uint8Array",
    "uint16": "Uint16Array",
    "uint32": "Uint32Array",
    "uint64": "BigUint64Array",
}


def acting_tfjs(bundle: Bundle) -> str:
    """policy.mjs with TensorFlow.js."""
    return _page(bundle, _TFJS, "acting_tfjs.mjs", "tfjs/model.json", _agents(bundle))


def acting_node(bundle: Bundle) -> str:
    """policy.mjs with TensorFlow.js, for Node."""
    return _program(bundle, _TFJS, "acting_tfjs.mjs", "tfjs/model.json", _agents(bundle), "node.mjs")


def acting_ort(bundle: Bundle) -> str:
    """policy.mjs with onnxruntime-web."""
    return _page(bundle, _ORT, "acting_ort.mjs", f"{bundle.name}.onnx", _agents(bundle))


def plain_tfjs(bundle: Bundle) -> str:
    """``tf.loadGraphModel`` alone."""
    run = "const outputs = model.predict(feeds);  // tensors by name; dispose of them in a long run: tf.dispose"
    play = _plain(bundle, _tf_value, run, "const {} = await outputs[{}].array();")
    return _page(bundle, _TFJS, "plain_tfjs.mjs", "tfjs/model.json", play)


def plain_ort(bundle: Bundle) -> str:
    """onnxruntime-web alone."""
    run = "const outputs = await session.run(feeds);"
    play = _plain(bundle, _ort_value, run, "const {} = Array.from(outputs[{}].data, Number);")
    return _page(bundle, _ORT, "plain_ort.mjs", f"{bundle.name}.onnx", play)


def _page(bundle: Bundle, runtime: tuple[str, str], frame: str, model: str, play: str) -> str:
    return _program(bundle, runtime, frame, model, play, "page.html")


def _program(bundle: Bundle, runtime: tuple[str, str], frame: str, model: str, play: str, whole: str) -> str:
    code = fill_template(frame, module=_url(bundle, "tfjs/policy.mjs"), model=_url(bundle, model), play=play)
    return fill_template(whole, name=bundle.name, package=runtime[0], module=runtime[1], code=code.rstrip())


def _url(bundle: Bundle, relative: str) -> str:
    return string_literal(f"./{bundle.name}/{relative}")


def _agents(bundle: Bundle) -> str:
    lines = ["const decision = await agents.decide({"]
    for spec in bundle.signature.observations:
        lines += _entry(bundle, spec, _flat(spec))
    extra: list[str] = []
    for spec in bundle.signature.inputs:
        if spec.role is Role.MASKS:
            extra += [*_comment(bundle, spec), f"  masks: {_flat(spec)},"]
    parameters = [s for s in bundle.signature.inputs if s.role is Role.PARAMETER]
    if parameters:
        extra.append("  parameters: {")
        extra += [f"  {line}" for spec in parameters for line in _entry(bundle, spec, _flat(spec))]
        extra.append("  },")
    lines += ["}, {", *extra, "});"] if extra else ["});"]
    lines += [f"// {_safe(line)}" for head in bundle.heads for line in action_meaning(bundle, head)]
    lines.append(f"console.log({', '.join(f'decision.{kind}' for kind in bundle.kinds)});  // a row per agent")
    start = [
        "// agents.reset() where an episode begins; policy.agent({ deterministic: true }): no draws",
        "const agents = policy.agent();",
    ]
    return "\n".join([*start, *_loop_lines(bundle, lines)])


def _plain(bundle: Bundle, value: Callable[[TensorSpec], str], run: str, read: str) -> str:
    """The lines from feeds to actions, with what goes from step to step; ``read`` takes a variable and an output."""
    lines = ["const feeds = {"]
    for spec in bundle.signature.inputs:
        lines += _entry(bundle, spec, bundle.kept_variables.get(spec.name) or value(spec))
    lines += ["};", run]
    lines += [read.format(name, string_literal(output.name)) for name, output in bundle.fetched_outputs.items()]
    before = bundle.beginnings("let {} = {};  // {}", value)
    previous = bundle.previous
    lines += [f"{variable} = outputs[{string_literal(given)}];" for _, given, variable in bundle.memories]
    if previous is not None:
        lines.append(_again(previous, bundle.discrete_variable, tensorflow=value is _tf_value))
    lines += [f"// {_safe(line)}" for head in bundle.heads for line in action_meaning(bundle, head)]
    chance = [f"outputs[{string_literal(h.name)}]" for h in bundle.heads if bundle.plain(h) != h]
    hint = f"  // deterministic; drawn: {', '.join(chance)}" if chance else ""
    lines.append(f"console.log({', '.join(bundle.fetched_outputs)});{hint}")
    return "\n".join([*before, *_loop_lines(bundle, lines)])


def _again(spec: TensorSpec, taken: str, *, tensorflow: bool) -> str:
    shape = list(example_shape(spec))
    if tensorflow:
        return f'previous = tf.tensor({taken}.flat(), {shape}, "int32");'
    values = f"{taken}.map(BigInt)" if spec.dtype in ("int64", "uint64") else taken
    return f"previous = new ort.Tensor({string_literal(spec.dtype)}, {_ARRAYS[spec.dtype]}.from({values}), {shape});"


def _loop_lines(bundle: Bundle, lines: list[str]) -> list[str]:
    if not bundle.remembers:
        return lines
    return [f"for (let step = 0; step < {STEPS}; step++) {{", *(f"  {line}" for line in lines), "}"]


def _entry(bundle: Bundle, spec: TensorSpec, value: str) -> list[str]:
    key = spec.name if re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", spec.name) else string_literal(spec.name)
    return [*_comment(bundle, spec), f"  {key}: {value},"]


def _comment(bundle: Bundle, spec: TensorSpec) -> list[str]:
    return [f"  // {_safe(line)}" for line in meaning(bundle, spec)]


def _safe(comment: str) -> str:
    """A comment that cannot end the script it stands in."""
    return comment.replace("<", "‹")


def _tf_value(spec: TensorSpec) -> str:
    maker = "ones" if spec.role is Role.MASKS else "zeros"
    dtype = "int32" if spec.dtype == "int64" else spec.dtype
    return f"tf.{maker}({list(example_shape(spec))}{'' if dtype == 'float32' else f', {string_literal(dtype)}'})"


def _ort_value(spec: TensorSpec) -> str:
    shape = example_shape(spec)
    return f"new ort.Tensor({string_literal(spec.dtype)}, {_flat(spec, _ARRAYS[spec.dtype])}, {list(shape)})"


def _flat(spec: TensorSpec, kind: str | None = None) -> str:
    """A typed array of one agent's numbers; policy.mjs takes int64 as 32 bits."""
    kind = kind or ("Int32Array" if spec.dtype == "int64" else _ARRAYS[spec.dtype])
    one = "1n" if kind.startswith("Big") else "1"
    return f"new {kind}({example_size(spec)})" + (f".fill({one})" if spec.role is Role.MASKS else "")
