"""How much a graph may make out of little: a file of some bytes could claim the whole memory otherwise."""

from __future__ import annotations

#: Elements that all the constants of a graph may unfold to together. (A dense layer of ML-Agents has 1 << 18.)
MAX_MADE = 1 << 24

#: Numbers that are made where a graph is computed while it is read or written: all tensors of all rows together. A
#: policy has some thousands, a camera's a million.
MAX_COMPUTED = 1 << 24


class Allowance:
    """How many elements may still be made: by one reader, one inference, one writer of one graph."""

    def __init__(self, elements: int = MAX_MADE) -> None:
        self.left = elements

    def take(self, elements: int) -> bool:
        """Count ``elements``; False where that is too much, and from then on for whatever is more than none."""
        if elements:
            self.left -= elements
        return not elements or self.left >= 0
