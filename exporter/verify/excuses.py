"""What forgives a difference: a rule with a name each, asked in this order, that says which elements it forgave.

A rule that has no number of its own to hold an answer to leaves an element open: the verdict counts those. Rounding
forgives no more than an output varies over typical inputs, no rule a class that is not as good. A NaN beside a number
agrees by none: where arithmetic explains it, the output is not verified. docs/agreement.md has a row for each.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from msgspec import Struct


class Excuse(Struct, frozen=True):
    """A rule that forgives: ``title`` names it in reports, ``hides`` says the bluntest fault that it may hide."""

    title: str
    #: Elements that it forgives were held to no number.
    leaves_open: bool
    what: str
    hides: str
    #: It explains a NaN or infinity beside a finite number: that is no fault of a file, and no agreement.
    unproven: bool = False


ZERO_INPUTS = Excuse(
    "denormal inputs taken for zero",
    False,
    "the answer is the reference's to the same inputs with zeros for numbers below 2⁻¹²⁶",
    "an input that is dropped, at denormal inputs alone",
)
ROUNDING = Excuse(
    "rounding",
    False,
    "at most four times what moving every intermediate result by its rounding makes of that element",
    "a fault as small as that, at the inputs that have it",
)
CHAOS = Excuse(
    "rounding moves it as far as it varies",
    True,
    "rounding explains a tenth of the output's range over typical inputs or more; the range is then the bound",
    "any answer of the output's range, where a formula loses all its digits",
)
TIE = Excuse(
    "as good a choice",
    False,
    "another class whose score is as good as the best one's, within 1e-5 or rounding; what follows from it",
    "a preference among classes that tie",
)
NEVER = Excuse(
    "log-probabilities that say never",
    False,
    "of n classes all below n·2⁻¹²⁶ of the likeliest are one value",
    "a probability of 1e-38 that is 1e-45, or 0",
)
NOT_FROM_ZERO = Excuse(
    "not told from zero",
    True,
    "at far inputs, between what taking for zero, keeping, and float64 make of numbers that a runtime cannot tell from "
    "zero, or as far beyond: log(sigmoid(−30)); NaN beside infinity where they taken for zero make NaN",
    "the logarithm of nearly nothing as any other, at far inputs alone",
)
NAN_FROM_ZERO = Excuse(
    "NaN of what is not told from zero",
    True,
    "at far inputs, NaN or infinity beside a number where such numbers taken for zero make NaN: log(0) − log(0)",
    "nothing: the output is not verified",
    unproven=True,
)
FLOAT64 = Excuse(
    "float64's own answer",
    False,
    "the answer is float64's, and the reference's rests on what its runtime cannot tell from zero: log(sigmoid(−18))",
    "nothing: the answer is right",
)
NO_DEVIATION = Excuse(
    "NaN in the reference alone",
    True,
    "the action without noise, where the source multiplies no noise by a deviation that overflowed",
    "any number there",
)
BOTH_NAN = Excuse(
    "NaN on both sides",
    True,
    "neither answer is a number",
    "a formula that makes another NaN of them",
)
#: In the order in which they are asked.
EXCUSES = (BOTH_NAN, NO_DEVIATION, NEVER, ZERO_INPUTS, ROUNDING, CHAOS, TIE, FLOAT64, NOT_FROM_ZERO, NAN_FROM_ZERO)


class Forgiven(Struct, frozen=True):
    """How many elements a rule forgave, and the largest of their differences (infinite where that is no number)."""

    excuse: Excuse
    elements: int
    most: float

    def to_dict(self) -> dict[str, Any]:
        """As in parity.json."""
        most = self.most if self.most < float("inf") else "inf"
        return {"excuse": self.excuse.title, "elements": self.elements, "most": most, "open": self.excuse.leaves_open}


def add_forgiven(several: Iterable[Iterable[Forgiven]]) -> tuple[Forgiven, ...]:
    """What was forgiven over several inputs, outputs or formats, by rule."""
    found: dict[str, list[Forgiven]] = {}
    for each in (f for one in several for f in one):
        found.setdefault(each.excuse.title, []).append(each)
    return tuple(
        Forgiven(e, sum(f.elements for f in found[e.title]), max(f.most for f in found[e.title]))
        for e in EXCUSES
        if e.title in found
    )


def forgiven_text(forgiven: Iterable[Forgiven], elements: int) -> str:
    """A clause for each rule: "6 of 40,000 elements: rounding (up to 3e-05)"."""
    shown = []
    for each in forgiven:
        most = f" (up to {each.most:.2g})" if 0 < each.most < float("inf") else ""
        shown.append(f"{each.elements:,} of {elements:,} elements: {each.excuse.title}{most}")
    return "; ".join(shown)
