"""One spelling for everything: ops, attributes and layouts of all TensorFlow generations to those of TF 1.4.

Precondition: a pruned graph as the reader gave it. Postcondition: every op stands in the op table (or is control
flow), attributes are complete with their defaults, no attribute that TF 1.4 lacks differs from its default but
``dilations`` and ``output_dtype``, images are NHWC, and no op is left that TF 1.4 cannot express in others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nn.convolution import Window, conv2d
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.base import MISFIT, REQUIRED, Attr, AttrKind, misfit
from export_model.converters.graph.ops.older import TO_NCHW, TO_NHWC
from export_model.converters.graph.ops.table import CONTROL_FLOW, SPELLINGS, TABLE, op_of, unsupported_error
from export_model.converters.graph.types import FLOAT32, INT64
from export_model.signatures.errors import GraphError, UnsupportedOpError


def normalise(graph: Graph, keep: Sequence[str] = ()) -> Graph:
    """Return the graph in one spelling (see the module).

    A node in ``keep`` is there under its name afterwards, whatever its op became. Raises UnsupportedOpError that names
    every node whose op is unknown.
    """
    renamed = [replace(n, op=SPELLINGS[n.op]) if n.op in SPELLINGS else n for n in graph.nodes]
    unknown = [n for n in renamed if n.op not in TABLE and n.op not in CONTROL_FLOW]
    if unknown:
        raise unsupported_error(unknown)
    editor = Editor(graph)
    for node, given in zip(renamed, graph.nodes, strict=True):
        if node.op in CONTROL_FLOW:
            editor.keep(node)
        elif older := op_of(node).older:
            try:
                editor.write_older(given, older)
            except MISFIT as error:
                raise misfit(given, error) from error
        else:
            _take(editor, _complete_attrs(node))
    for name in keep:
        if (now := editor.resolve(name)) != name:
            editor.append(Node(name, "Identity", (now,), origin=graph[name].origin))
    return editor.graph()


def _complete_attrs(node: Node) -> Node:
    """Attributes filled with defaults, derived ones dropped, unsupported ones refused."""
    attrs: dict[str, Any] = {}
    known = {a.name: a for a in op_of(node).attrs}
    for name, attr in known.items():
        given = node.attrs.get(name)
        if attr.derive is not None:
            _check_count(node, attr, given)
            continue
        if given is None:
            if attr.default is REQUIRED:
                raise GraphError(
                    f"node {node.name!r} ({node.op}) lacks the attribute {name!r}",
                    why="the op cannot be computed without it",
                    fix="the graph is damaged; freeze it again from its checkpoint",
                )
            given = attr.default
        _check_kind(node, attr, given)
        if not attr.supported and given != attr.default and not (name == "explicit_paddings" and not any(given)):
            if name == "explicit_paddings" and node.attrs.get("padding") == "EXPLICIT":
                attrs[name] = given
                continue
            raise UnsupportedOpError(
                f"cannot convert {node.op} (node {node.name!r}) with {name}={given!r}",
                issues=[(node.name, node.op)],
                why="no kernel here computes that variant, and the older runtimes do not know the attribute",
                fix="please open an issue with the graph",
            )
        attrs[name] = given if attr.supported else attr.default
    same = attrs.keys() == node.attrs.keys() and all(attrs[name] is node.attrs[name] for name in attrs)
    return node if same else replace(node, attrs=attrs)


def _check_count(node: Node, attr: Attr, given: Any) -> None:
    """Raise GraphError where a node says to have other than the inputs that it has: every TensorFlow refuses it."""
    side, _, others = str(attr.derive).partition(":")
    if side != "count" or given is None:
        return
    count = len(node.inputs) - int(others or 0)
    if given != count:
        raise GraphError(
            f"node {node.name!r} ({node.op}) says {attr.name}={given}, and has {count} inputs",
            why="it is how many it joins",
            fix="the graph is damaged; freeze it again from its checkpoint",
        )


#: What an attribute of each kind is, or each item of a list of them.
_KINDS: Mapping[AttrKind, tuple[type, ...]] = {
    "type": (np.dtype,),
    "int": (int, np.integer),
    "float": (float, int, np.number),
    "bool": (bool, np.bool_),
    "str": (str,),
    "shape": (TensorShape,),
}

_WORDS = {
    "type": "a dtype",
    "int": "an integer",
    "float": "a number",
    "bool": "true or false",
    "str": "text",
    "shape": "a shape",
}


def _check_kind(node: Node, attr: Attr, given: Any) -> None:
    """Raise GraphError where an attribute is of another kind than its op has it."""
    items = given if isinstance(given, tuple) else (given,)
    single = not isinstance(attr.default, tuple) and attr.default is not REQUIRED
    if (single and isinstance(given, tuple)) or not all(isinstance(i, _KINDS[attr.kind]) for i in items):
        raise GraphError(
            f"node {node.name!r} ({node.op}) has {attr.name}={str(given)[:80]}; it must be {_WORDS[attr.kind]}",
            why="the op cannot be computed without it",
            fix="the graph is damaged; freeze it again from its checkpoint",
        )


def _take(editor: Editor, node: Node) -> None:
    """Keep a node, its padding and layout brought to the one form that all targets share."""
    if node.op == "Multinomial" and node.attrs["output_dtype"] != INT64:
        _draw_int64(editor, node)
        return
    if node.attrs.get("padding") == "EXPLICIT":
        node = _split_padding(editor, node)
    layout = node.attrs.get("data_format", "NHWC")
    if layout == "NCHW":
        _turn_round(editor, node)
    elif layout != "NHWC":
        raise UnsupportedOpError(
            f"cannot convert {node.op} (node {node.name!r}) with data_format={layout!r}",
            issues=[(node.name, node.op)],
            why="only NHWC and NCHW images occur in policies",
        )
    elif node.op == "Conv2D" and (parts := _split_groups(editor, node)):
        editor.redirect(node.name, parts)
    else:
        editor.keep(node)


def _split_groups(editor: Editor, node: Node) -> str:
    """A convolution in groups, whose kernel takes a part of the channels, as one per group; "" for any other."""
    shapes = [editor.shape_of(r) for r in node.inputs]
    image, kernel = ([n for n in s or () if isinstance(n, int)] for s in shapes)
    if len(kernel) != 4 or not image or shapes[0] is None or shapes[0][-1] != image[-1]:
        return ""
    height, width, taken, _ = kernel
    if image[-1] == taken or not taken or image[-1] % taken:
        return ""
    (_, down, across, _), (_, *dilations, _) = node.attrs["strides"], node.attrs["dilations"]
    same, groups = node.attrs["padding"] == "SAME", image[-1] // taken
    window = Window((height, width), (down, across), (dilations[0], dilations[1]), same=same)
    try:
        (made,) = editor.write(node.inputs, lambda b, x, k: [conv2d(b, x, k, window, groups)], node.name)
    except UnsupportedOpError as error:
        what = f"cannot convert Conv2D (node {node.name!r}): {error.what}"
        raise UnsupportedOpError(what, issues=[(node.name, node.op)], why=error.why) from error
    return made


def _draw_int64(editor: Editor, node: Node) -> None:
    """A draw of int32 as a Cast of one of int64: TF 1.4 has no output_dtype."""
    wide = {**node.attrs, "output_dtype": INT64}
    drawn = editor.add("Multinomial", node.inputs, f"{node.name}/int64", node.origin, **wide)
    narrow = editor.add("Cast", [drawn], f"{node.name}/narrow", node.origin, DstT=node.attrs["output_dtype"])
    editor.redirect(node.name, narrow)


def _split_padding(editor: Editor, node: Node) -> Node:
    """padding=EXPLICIT as a Pad before a VALID window (TF 1.x has no explicit padding)."""
    if node.op == "MaxPool":
        raise UnsupportedOpError(
            f"cannot convert MaxPool (node {node.name!r}) with explicit padding", issues=[(node.name, node.op)]
        )
    pads = np.array(node.attrs["explicit_paddings"], np.int32).reshape(-1, 2)
    padded = editor.add("Pad", [node.inputs[0], editor.const(pads, f"{node.name}/pads")], f"{node.name}/pad")
    attrs = {**node.attrs, "padding": "VALID", "explicit_paddings": ()}
    return replace(node, inputs=(padded, *node.inputs[1:]), attrs=attrs)


def _turn_round(editor: Editor, node: Node) -> None:
    """An NCHW window op (graphs trained on GPUs) as NHWC between two transposes."""
    attrs = {**node.attrs, "data_format": "NHWC"}
    for key in ("strides", "ksize", "dilations"):
        if key in attrs:
            n, c, h, w = attrs[key]
            attrs[key] = (n, h, w, c)
    before = editor.add(
        "Transpose", [node.inputs[0], editor.const(TO_NHWC, f"{node.name}/nhwc/perm")], f"{node.name}/nhwc"
    )
    inner = editor.add(node.op, [before, *node.inputs[1:]], f"{node.name}/inner", **attrs)
    after = editor.add(
        "Transpose", [inner, editor.const(TO_NCHW, f"{node.name}/nchw/perm")], f"{node.name}/nchw", node.origin
    )
    editor.redirect(node.name, after)


def as_placeholder(node: Node) -> Node:
    """A PlaceholderWithDefault that the policy's signature names, as a plain Placeholder."""
    return Node(
        node.name,
        "Placeholder",
        (),
        {"dtype": node.attrs.get("dtype", FLOAT32), "shape": node.attrs.get("shape", TensorShape(None))},
        origin=node.origin,
    )
