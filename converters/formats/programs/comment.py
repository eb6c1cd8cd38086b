"""The comment at the head of source code: what is stated of the numbers, and the contract."""

from __future__ import annotations

import json

from export_model.converters.interfaces.text import ALL, loop_lines, term_lines
from export_model.signatures.spec import PolicySignature

#: Begins a line of what is stated.
LINE = "   | "


def escape(text: str) -> str:
    """Return a text in ASCII that cannot leave a comment, nor begin one in it."""
    text = "".join(c if c.isascii() else json.dumps(c)[1:-1] for c in text)
    return text.replace("*/", "*\\/").replace("/*", "/\\u002a")


def interface_lines(signature: PolicySignature) -> str:
    """Comment lines on what is stated of the numbers; none can be taken for the contract's, which begins otherwise."""
    specs = (*signature.inputs, *(head.spec for head in signature.heads))
    named = [(s.name, line) for s in specs for line in term_lines(signature, s.name)]
    lines = [*(f"{name}: {line}" for name, line in named), *loop_lines(signature.interface, ALL)]
    return "".join(f"{LINE}{escape(' '.join(line.split()))}\n" for line in lines)
