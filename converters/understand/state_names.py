"""Names of memories: ``h_in`` and ``h_out``, ``hx`` and ``new_hx``, ``state_in_0`` and ``state_out_0``."""

from __future__ import annotations

import re
from collections.abc import Sequence

from converters.graph.nodes import node_of

#: Words of a tensor's name that say that it is a memory.
_STATE_WORDS = frozenset(
    (
        *("h", "c", "hx", "cx", "hn", "cn", "hidden", "hiddens", "cell", "cells", "state", "states", "carry"),
        *("memory", "memories", "recurrent", "rnn", "lstm", "gru"),
    )
)
#: Words that say no more than which end of the step it is.
_ENDS = frozenset(("in", "out", "input", "output", "next", "new", "prev", "previous", "last", "old", "initial", "init"))
_CELL_WORDS, _HIDDEN_WORDS = frozenset(("c", "cx", "cell", "cells")), frozenset(("h", "hx", "hidden", "hiddens"))


def looks_like_state(name: str) -> bool:
    """Whether an output's name says that it is fed back at the next step."""
    return bool(_STATE_WORDS & {w.rstrip("0123456789") for w in _words(name)})


def _words(name: str) -> list[str]:
    """``"stateOut_0"`` as state, out, 0; ``"h0"`` and ``"hn"`` as h (PyTorch's names for a step's two ends), but
    ``"h1_in"`` as h1, in: the first of several.
    """
    base = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", node_of(name).rsplit("/", 1)[-1])
    words = [w for w in re.split(r"[^a-z0-9]+", base.lower()) if w]
    if _ENDS & {*words}:
        return words
    return [w[0] if w in ("h0", "c0", "hn", "cn", "h1", "c1", "ht", "ct") else w for w in words]


def stem_of(name: str) -> tuple[str, ...]:
    """What is left of a name without the words for a step's two ends: the same for both tensors of a memory."""
    return tuple(w for w in _words(name) if w not in _ENDS)


def part_of(stem: Sequence[str]) -> str:
    """``c`` or ``h``, where the words say which; else empty."""
    return "c" if _CELL_WORDS & {*stem} else "h" if _HIDDEN_WORDS & {*stem} else ""
