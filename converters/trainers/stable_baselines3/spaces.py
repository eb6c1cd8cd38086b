"""Spaces of gym and gymnasium, by the text that stands beside their pickles in ``data``.

Source: save_util.py (``data_to_json`` writes ``str`` of every attribute that JSON lacks), gymnasium/spaces/*.py. Arrays
are numpy's text, which leaves out the middle of more than a thousand numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.signatures.errors import DamagedFileError, SourceError

_NUMBER = re.compile(r"[-+]?(?:inf|nan|\d+\.?\d*(?:e[-+]?\d+)?|\.\d+)", re.IGNORECASE)
_MEMBER = re.compile(r"""(['"])((?:[^'"\\]|\\.){0,80})\1\s*[:,]\s*(Box|Discrete|MultiDiscrete|MultiBinary)\(""")
_KINDS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
#: Characters of a Dict's text; members of a thousand numbers take some ten thousand.
_MAX_TEXT = 1 << 17
_SAVE_AGAIN = "save the model again: model.save"


class Space(Struct, frozen=True):
    """One space.

    ``counts``: how many values (Discrete has one number, MultiDiscrete some); ``low`` and ``high``: the text of a Box's
    bounds.
    """

    kind: str
    shape: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()
    dtype: str = "float32"
    low: str = ""
    high: str = ""

    @property
    def image(self) -> bool:
        """``is_image_space``: bytes of 0 to 255 on three axes."""
        bounds = [{float(n) for n in _NUMBER.findall(text)} for text in (self.low, self.high)]
        return self.kind == "Box" and len(self.shape) == 3 and self.dtype == "uint8" and bounds == [{0.0}, {255.0}]

    @property
    def size(self) -> int:
        """How many numbers a policy's network gets of it (``get_flattened_obs_dim``)."""
        return sum(self.counts) if self.counts else math.prod(self.shape)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """A Box's bounds, float32, flat. Raises SourceError where the text leaves some out."""
        found = []
        for text in (self.low, self.high):
            with np.errstate(over="ignore"):
                numbers = np.array([float(n) for n in _NUMBER.findall(text)], np.float32)
            if len(numbers) not in (1, self.size) or "..." in text:
                raise SourceError(
                    f"the bounds of its {self.size} actions are not known",
                    why="the text of so many numbers leaves out the middle",
                    fix="export the model to ONNX in its own project (torch.onnx.export), and give that",
                )
            found.append(np.broadcast_to(numbers, (self.size,)))
        return found[0], found[1]


def space_of(data: Mapping[str, Any], name: str) -> Space | dict[str, Space]:
    """The space that ``data`` describes under ``name``; a Dict's by key, in their order.

    Raises DamagedFileError where it describes none, SourceError for a kind that policies of the library do not take.
    """
    entry = data.get(name)
    kind = _class_name(entry.get(":type:")) if isinstance(entry, dict) else ""
    if not isinstance(entry, dict) or not kind:
        raise DamagedFileError(f"its data has no {name}", why="every saved model has one", fix=_SAVE_AGAIN)
    if kind == "Dict":
        return _members(entry.get("spaces"), name)
    if kind not in _KINDS:
        raise SourceError(
            f"its {name} is a {kind[:40]}",
            why=f"{', '.join(_KINDS)} and Dict are read",
            fix="export the model to ONNX in its own project (torch.onnx.export), and give that",
        )
    counted = {"Discrete": "n", "MultiDiscrete": "nvec"}.get(kind)
    shape = _whole(entry.get("_shape", entry.get("shape")), name)
    return Space(
        kind,
        shape or (_whole(entry.get("n"), name) if kind == "MultiBinary" else ()),
        _whole(entry.get(counted), name) if counted else (),
        str(entry.get("dtype", "float32"))[-32:].strip("'<>").rpartition(".")[2],
        str(entry.get("low", "")),
        str(entry.get("high", "")),
    )


def _class_name(text: Any) -> str:
    """``Box`` of ``<class 'gymnasium.spaces.box.Box'>``."""
    return text.strip("<>").rpartition(".")[2].strip("'") if isinstance(text, str) else ""


def _whole(value: Any, name: str) -> tuple[int, ...]:
    """Whole numbers of JSON, or of a text like ``[3 2]``."""
    found = value if isinstance(value, list) else re.findall(r"-?\d+", str(value))
    try:
        numbers = tuple(int(n) for n in found)
    except (TypeError, ValueError, OverflowError) as error:
        raise DamagedFileError(f"the shape of its {name} is none", why=str(error)[:80], fix=_SAVE_AGAIN) from error
    if len(numbers) > 1000 or any(not 0 <= n < 1 << 31 for n in numbers):
        raise DamagedFileError(f"the shape of its {name} is none", why=str(numbers)[:80], fix=_SAVE_AGAIN)
    return numbers


def _members(text: Any, name: str) -> dict[str, Space]:
    """The members of a Dict, of their text: ``{'arm': Box(-1.0, 1.0, (3,), float32), 'gear': Discrete(4)}``."""
    found: dict[str, Space] = {}
    text = text if isinstance(text, str) else ""
    if len(text) > _MAX_TEXT:
        raise DamagedFileError(f"the text of its {name} has {len(text)} characters", fix=_SAVE_AGAIN)
    for match in _MEMBER.finditer(text):
        key, kind, end, depth = match[2], match[3], match.end(), 1
        while end < len(text) and depth:
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        if depth:
            raise DamagedFileError(f"the text of its {name} is cut off in {key[:40]!r}", fix=_SAVE_AGAIN)
        inner = text[match.end() : end - 1]
        if kind == "Box":
            bounds, _, rest = inner.rpartition("(")
            shape, _, dtype = rest.partition(")")
            low, _, high = bounds.rstrip(", ").rpartition(", ")
            found[key] = Space(kind, _whole(shape, name), (), dtype.strip(", "), low, high)
        else:
            numbers = _whole(inner.partition("start=")[0], name)
            found[key] = Space(kind, numbers) if kind == "MultiBinary" else Space(kind, (), numbers)
    if not found:
        raise DamagedFileError(f"its {name} has no members", why="a Dict has some", fix=_SAVE_AGAIN)
    return found
