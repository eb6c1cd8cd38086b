"""Snippets in JavaScript: policy.mjs, plain TensorFlow.js and onnxruntime-web, each a page of its own, or for Node.

A page lies beside the bundle's folder and takes its runtime from ``node_modules`` there, so that no network is needed,
or from a CDN by its hash.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import StrEnum

from export_model.exporter.snippets.contract import (
    ODDS,
    STEPS,
    SnippetBundle,
    action_meaning,
    agent_text,
    example_shape,
    example_size,
    fill_template,
    is_drawn_inside,
    meaning,
    string_literal,
)
from export_model.exporter.snippets.packages import ORT, TFJS, Package
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

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


class CodePlace(StrEnum):
    """Where the code runs, and where its runtime comes from."""

    PAGE = "page"
    CDN = "cdn"
    NODE = "node"


def acting_tfjs(bundle: SnippetBundle, place: CodePlace = CodePlace.PAGE) -> str:
    """policy.mjs with TensorFlow.js."""
    return _program(bundle, TFJS, "acting_tfjs.mjs", "tfjs/model.json", _agents(bundle), place)


def acting_ort(bundle: SnippetBundle, place: CodePlace = CodePlace.PAGE) -> str:
    """policy.mjs with onnxruntime-web."""
    return _program(bundle, ORT, "acting_ort.mjs", f"{bundle.name}.onnx", _agents(bundle), place)


def plain_tfjs(bundle: SnippetBundle, place: CodePlace = CodePlace.PAGE) -> str:
    """``tf.loadGraphModel`` alone."""
    run = "const outputs = model.predict(feeds);  // tensors by name; dispose of them in a long run: tf.dispose"
    play = _plain(bundle, _tf_value, run, "await outputs[{}].array()")
    if place is CodePlace.NODE:  # there is no loader for files in the package
        return _program(bundle, TFJS, "plain_tfjs_node.mjs", "tfjs/", play, place)
    return _program(bundle, TFJS, "plain_tfjs.mjs", "tfjs/model.json", play, place)


def plain_ort(bundle: SnippetBundle, place: CodePlace = CodePlace.PAGE) -> str:
    """onnxruntime-web alone."""
    run = "const outputs = await session.run(feeds);"
    play = _plain(bundle, _ort_value, run, "Array.from(outputs[{}].data, Number)")
    frame = "plain_ort_node.mjs" if place is CodePlace.NODE else "plain_ort.mjs"
    return _program(bundle, ORT, frame, f"{bundle.name}.onnx", play, place)


def _program(bundle: SnippetBundle, runtime: Package, frame: str, model: str, play: str, place: CodePlace) -> str:
    code = fill_template(frame, module=_url(bundle, "tfjs/policy.mjs"), model=_url(bundle, model), play=play).rstrip()
    install = f"npm install {runtime.name}@{runtime.version}"
    if place is CodePlace.NODE:
        return fill_template("node.mjs", name=bundle.name, how=install, code=code)
    server = "python3 -m http.server"
    how = server if place is CodePlace.CDN else f"{install}; {server}"
    imports = runtime.import_map(cdn=place is CodePlace.CDN)
    return fill_template("page.html", name=bundle.name, how=how, imports=imports, code=code)


def _url(bundle: SnippetBundle, relative: str) -> str:
    return string_literal(f"./{bundle.name}/{relative}")


def _agents(bundle: SnippetBundle) -> str:
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
    for head in bundle.heads:
        lines += [f"// {_safe(line)}" for line in action_meaning(bundle, head, "policy.agent()")]
    lines.append(f"console.log({', '.join(f'decision.{kind}' for kind in bundle.kinds)});  // a row per agent")
    how = "" if any(is_drawn_inside(bundle, head) for head in bundle.heads) else "{ deterministic: true }"
    start = [f"// {agent_text(bundle)}", f"const agents = policy.agent({how});"]
    return "\n".join([*start, *_loop_lines(bundle, lines)])


def _plain(bundle: SnippetBundle, value: Callable[[TensorSpec], str], run: str, read: str) -> str:
    """The lines from feeds to actions, with what goes from step to step; ``read`` takes an output."""
    lines = ["const feeds = {"]
    for spec in bundle.signature.inputs:
        lines += _entry(bundle, spec, bundle.kept_variables.get(spec.name) or value(spec))
    lines += ["};", run]
    for name, output in bundle.fetched_outputs.items():
        found, tensorflow = read.format(string_literal(output.name)), value is _tf_value
        likeliest = f"({found}).map(likeliest)" if tensorflow else f"likeliest({found})"
        lines.append(f"const {name} = {likeliest if output.role in ODDS else found};")
    before = [*_likeliest(bundle), *bundle.beginnings("let {} = {};  // {}", value)]
    previous = bundle.previous
    lines += [f"{variable} = outputs[{string_literal(given)}];" for _, given, variable in bundle.memories]
    if previous is not None:
        lines.append(_again(previous, bundle.discrete_variable, tensorflow=value is _tf_value))
    lines += [f"// {_safe(line)}" for head in bundle.heads for line in action_meaning(bundle, head)]
    lines.append(f"console.log({', '.join(bundle.variables)});")
    return "\n".join([*before, *_loop_lines(bundle, lines)])


def _likeliest(bundle: SnippetBundle) -> list[str]:
    """The function that takes the likeliest class of each branch, where odds are all that there is."""
    if not any(output.role in ODDS for output in bundle.fetched_outputs.values()):
        return []
    return [
        "const likeliest = (row) => {",
        "  let end = 0;",
        f"  return {list(bundle.signature.branches)}.map((size) => {{",
        "    const branch = row.slice(end, (end += size));",
        "    return branch.indexOf(Math.max(...branch));",
        "  });",
        "};",
    ]


def _again(spec: TensorSpec, taken: str, *, tensorflow: bool) -> str:
    shape = list(example_shape(spec))
    if tensorflow:
        return f'previous = tf.tensor({taken}.flat(), {shape}, "int32");'
    values = f"{taken}.map(BigInt)" if spec.dtype in ("int64", "uint64") else taken
    return f"previous = new ort.Tensor({string_literal(spec.dtype)}, {_ARRAYS[spec.dtype]}.from({values}), {shape});"


def _loop_lines(bundle: SnippetBundle, lines: list[str]) -> list[str]:
    if not bundle.remembers:
        return lines
    return [f"for (let step = 0; step < {STEPS}; step++) {{", *(f"  {line}" for line in lines), "}"]


def _entry(bundle: SnippetBundle, spec: TensorSpec, value: str) -> list[str]:
    key = spec.name if re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", spec.name) else string_literal(spec.name)
    return [*_comment(bundle, spec), f"  {key}: {value},"]


def _comment(bundle: SnippetBundle, spec: TensorSpec) -> list[str]:
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
