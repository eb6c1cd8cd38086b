"""Faults of what is no graph: functions of source code that callers call, and what an ONNX says of the numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

#: A file's bytes → those with the fault; the same where it cannot have it.
Edit = Callable[[bytes], bytes]

ONE_MEMORY = "act_all: one memory for all"
#: Fault → format → (what a file has, what stands in its place).
_CODE = {
    "act without noise": {
        "c": (r"\n    \w+_normal\(memory, \S+, \d+\);", ""),
        "js": (r"\n        this\._normal\(this\.\w+\);", ""),
        "csharp": (r"\n        _Normal\(this\.\w+\);", ""),
    },
    "act with twice the noise": {
        "c": (
            r"(\n    \w+_normal\(memory, (\S+), (\d+)\);)",
            r"\1 for (int i = 0; i < \3; i++) \2[i] = \2[i] * 2.0f;",
        ),
        "js": (r"(\n        this\._normal\((this\.\w+)\);)", r"\1 \2.forEach((x, i) => { \2[i] = x * 2; });"),
        "csharp": (
            r"(\n        _Normal\((this\.\w+)\);)",
            r"\1 for (int i = 0; i < \2.Length; i++) \2[i] = \2[i] * 2.0f;",
        ),
    },
    "choose: the least likely": {
        "c": (r"= row\[i\] - logf", "= -row[i] - logf"),
        "js": (r"fround\(this\.(\w+)\[start \+ i\] - ", r"fround(-this.\1[start + i] - "),
        "csharp": (r"= this\.(\w+)\[start \+ i\] - _Log", r"= -this.\1[start + i] - _Log"),
    },
    "choose: the most likely": {
        "c": (r"= row\[i\] - logf", "= row[i] - 0.0f * logf"),
        "js": (r"\[start \+ i\] - fround", "[start + i] - 0 * fround"),
        "csharp": (r"\[start \+ i\] - _Log", "[start + i] - 0.0f * _Log"),
    },
    ONE_MEMORY: {"c": (r"&memory\[i\], &output\[i\]", "&memory[0], &output[i]")},
}
#: Metadata of an ONNX → what it says instead.
_METADATA: dict[str, Callable[[list[str]], list[str]]] = {
    "joint_names": lambda parts: [*parts[1:], parts[0]],
    "action_scale": lambda parts: [str(2 * float(p)) for p in parts],
    "default_joint_pos": lambda parts: [str(float(p) + 0.1) for p in parts],
}


def edits(form: str, content: bytes) -> Iterator[tuple[str, Edit]]:
    """The faults that a file can have, with what makes each."""
    for kind, forms in _CODE.items():
        if form in forms and re.search(forms[form][0].encode(), content):
            pattern, instead = (text.encode() for text in forms[form])
            yield kind, lambda data, p=pattern, i=instead: re.sub(p, i, data)  # type: ignore[misc]
    if form == "onnx":
        yield from ((f"metadata: {key}", lambda data, k=key: _reworded(data, k)) for key in _stated(content))  # type: ignore[misc]


def _stated(content: bytes) -> list[str]:
    import onnx

    return [p.key for p in onnx.ModelProto.FromString(content).metadata_props if p.key in _METADATA]


def _reworded(content: bytes, key: str) -> bytes:
    import onnx

    model = onnx.ModelProto.FromString(content)
    for entry in model.metadata_props:
        if entry.key == key:
            entry.value = ",".join(_METADATA[key](entry.value.split(",")))
    return model.SerializeToString()
