"""What the checks of a verification find: each renders itself as a sentence and as an entry of parity.json."""

from __future__ import annotations

import math
from typing import Any, ClassVar, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.children.process import RunFailedError
from export_model.exporter.verify.difference import by_decade
from export_model.exporter.verify.excuses import Forgiven, forgiven_text
from export_model.exporter.verify.statistics import FALSE_ALARM
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.fields import Record, explicit_default


class Bisection(Record, frozen=True):
    """Where a disagreement begins: the first tensor in graph order that differs in that runtime.

    ``source`` is the tensor of the source that it stands for. ``index`` is where the worst element is, ``expected`` and
    ``got`` its values. ``hidden`` are tensors right before it that the format does not have, because they were fused
    into its op: they may be the first as well. Where nothing could be named, ``tensor`` is None; ``reason`` says why.
    """

    tensor: str | None
    op: str | None = explicit_default(lambda: None)
    source: str | tuple[str, ...] | None = explicit_default(lambda: None)
    index: tuple[int, ...] | None = explicit_default(lambda: None)
    expected: float | None = explicit_default(lambda: None)
    got: float | None = explicit_default(lambda: None)
    max_abs_diff: float | None = explicit_default(lambda: None)
    smallest_tolerance: float | None = explicit_default(lambda: None)
    hidden: tuple[str, ...] = ()
    #: What was fed where that is not the comparison's worst input: the first step that differs.
    input: str | None = None
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """As in parity.json."""
        if self.tensor is None:
            return {"tensor": None, "reason": self.reason}
        return {k: _number(v) if isinstance(v, float) else v for k, v in super().to_dict().items()}

    def sentence(self) -> str:
        """Where it begins, in a line."""
        if self.tensor is None:
            return f"first difference: not found, {self.reason}"
        text = f"first difference: {self.tensor}"
        if self.op:
            text += f" ({self.op})"
        if self.source:
            text += f", in the source {self.source if isinstance(self.source, str) else ', '.join(self.source)}"
        if self.expected is not None and self.got is not None:
            place = "" if self.index is None else f" at {list(self.index)}"
            text += f":{place} expected {self.expected:.8g}, got {self.got:.8g}"
        if self.input is not None:
            text += f", fed {self.input}"
        if self.hidden:
            text += f"; not seen before it: {', '.join(self.hidden)}"
        return f"{text}; {self.reason}" if self.reason else text


class Finding(Struct, frozen=True):
    """What a check says of one output of one format in one runtime, over all inputs that it tried.

    Each kind says what it is called in parity.json, and how it is told in a sentence and in a table's cell.
    ``rounding`` is not zero where the worst difference is above the tolerance, but within what float32 explains.
    """

    kind: ClassVar[str]
    #: ``max_abs_diff`` is a difference of numbers, which a tolerance bounds.
    measured: ClassVar[bool] = False
    #: What a cell says of one that passed, and that did not, where it is no number.
    words: ClassVar[tuple[str, str] | None] = None
    #: What went wrong, where it is told otherwise than of a number.
    wrong: ClassVar[str] = ""
    #: Whether one that did not pass is a disagreement; else nothing was decided.
    judges: ClassVar[bool] = True

    format: str
    runtime: str
    output: str
    max_abs_diff: float
    max_rel_diff: float
    tolerance: Tolerance
    passed: bool
    worst_input: str | None
    reason: str = ""
    drift: tuple[float, ...] = ()
    rounding: float = 0.0
    #: Elements of all inputs per decade of ``|a − b|``, see exporter/verify/difference.py.
    histogram: tuple[int, ...] = ()
    #: The smallest t that would pass as atol and rtol; None where no tolerance would, or none is needed.
    smallest_tolerance: float | None = None
    #: Where a disagreement begins; None where it was not looked for (nothing failed, or the reason says it all).
    bisection: Bisection | None = None
    #: What it was held against where that is not the report's reference: the source has no odds of what is drawn.
    against: str = ""
    #: The largest difference as a share of what was allowed there, rounding included; it passes up to 1.
    share: float = 0.0
    #: How many elements of all inputs were compared, and how many of them which rule forgave.
    elements: int = 0
    forgiven: tuple[Forgiven, ...] = ()

    def __repr__(self) -> str:
        return f"<{self.where}: {self.output} {self.cell()}, {'ok' if self.passed else 'FAIL'} [{self.kind}]>"

    @property
    def disagrees(self) -> bool:
        """Whether something is wrong with what was compared."""
        return self.judges and not self.passed

    @property
    def where(self) -> str:
        """The format and the runtime."""
        return f"{self.format} in {self.runtime}"

    @property
    def forgiven_text(self) -> str:
        """What was forgiven, by which rule; empty where nothing was."""
        return forgiven_text(self.forgiven, self.elements)

    @property
    def bound_text(self) -> str:
        """What is allowed, as a formula."""
        return f"{self.tolerance.atol:g} + {self.tolerance.rtol:g}·|reference|"

    def cell(self) -> str:
        """What is said of the output in a table."""
        if self.words is not None:
            return self.words[not self.passed]
        return share_text(self.share)

    def short(self) -> str:
        """The same in a few characters, marked where it did not pass."""
        if self.passed or (self.measured and not self.reason):
            return self.cell()
        if not self.measured:
            return f"✗ {self.cell()}"
        return f"✗ {self.reason.split(' instead of')[0]}" if len(self.reason) < 40 else "✗"

    def columns(self) -> tuple[str, str, str, str]:
        """The share, the difference, the relative one and what is allowed, for a table.

        Each is empty where there is no such number.
        """
        return "", "", "", ""

    def sentence(self) -> str:
        """What went wrong, where this one did not pass."""
        if self.wrong:
            return self.wrong.format(self)
        text = f"{self.where}: {self.output} differs"
        if self.reason:
            text += f": {self.reason}"
        elif math.isfinite(self.max_abs_diff):
            text += f" by {self.max_abs_diff:.3g} (relative {self.max_rel_diff:.3g}), allowed {self.bound_text}"
        return f"{text} [{self.kind}, {self.worst_input}]"

    def explanation(self) -> list[str]:
        """Why it did not pass, a line each: what and where, the first tensor that differs, what would pass."""
        lines = [self.sentence()]
        if self.bisection is not None:
            lines.append(self.bisection.sentence())
        if not self.passed and self.smallest_tolerance is not None:
            least = _rounded_up(self.smallest_tolerance)
            lines.append(f"smallest tolerance that would pass: {least}, as atol and rtol")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """As in parity.json."""
        told = {
            "tolerance_reason": self.tolerance.reason,
            "rounding": self.rounding,
            "reason": self.reason,
            "drift": [_number(d) for d in self.drift],
            "histogram": by_decade(self.histogram) if any(self.histogram) else None,
            "smallest_tolerance": None if self.passed else self.smallest_tolerance,
            "bisection": None if self.bisection is None else self.bisection.to_dict(),
            "against": self.against,
            "forgiven": [{**f.to_dict(), "of": self.elements} for f in self.forgiven],
        }
        return {
            "format": self.format,
            "runtime": self.runtime,
            "output": self.output,
            "kind": self.kind,
            "max_abs_diff": _number(self.max_abs_diff),
            "max_rel_diff": _number(self.max_rel_diff),
            **({"share": _number(self.share)} if self.measured else {}),
            "atol": self.tolerance.atol,
            "rtol": self.tolerance.rtol,
            "passed": self.passed,
            "worst_input": self.worst_input,
            **{key: value for key, value in told.items() if value or (key == "smallest_tolerance" and value == 0)},
        }


class Numbers(Finding, frozen=True):
    """An output's numbers, inputs given one at a time."""

    kind = "numbers"
    measured = True

    def columns(self) -> tuple[str, str, str, str]:
        """As they are; where rounding explains more than the tolerance, it is what is allowed."""
        bound = f"{self.tolerance.atol:g} + {self.tolerance.rtol:g}·|b|"
        bound += f", rounding {self.rounding:.2g}" if self.rounding else ""
        return share_text(self.share), f"{self.max_abs_diff:.2e}", f"{self.max_rel_diff:.2e}", bound


class Rollout(Numbers, frozen=True):
    """An output's numbers with the memory fed back; ``drift`` has the worst difference of each step."""

    kind = "rollout"


class Acting(Numbers, frozen=True):
    """An output's numbers as callers of source code get them: several agents act, each by its own noise and state."""

    kind = "acting"


class Shape(Finding, frozen=True):
    """A drawn output's shape, dtype and range."""

    kind = "shape"
    words = ("drawn", "drawn")


class Draws(Shape, frozen=True):
    """How a drawn output is distributed; ``max_abs_diff`` is the p-value's complement."""

    kind = "draws"

    def columns(self) -> tuple[str, str, str, str]:
        """The p-value, and what it must reach."""
        return "", "", "", f"p >= {FALSE_ALARM:g}: p = {1 - self.max_abs_diff:.2g}"


class Decisions(Finding, frozen=True):
    """How many choices of a policy whose weights were rounded are other ones, or how far an action moves.

    The distance stands beside how far the action varies; ``reason`` says it whether it passed or not, ``runtime`` is
    what weights were rounded to.
    """

    kind = "decisions"
    wrong = "with weights rounded to {0.runtime}, {0.output} is another one: {0.reason}"

    def cell(self) -> str:
        """The share."""
        return f"{self.max_abs_diff:.2%} off"

    def columns(self) -> tuple[str, str, str, str]:
        """The share of choices, and what it may be."""
        return "", f"{self.max_abs_diff:.2%}", "", f"{self.tolerance.atol:.0%}"


class Failure(Finding, frozen=True):
    """A runtime that gave no answer; ``output`` is "*" where that is so for all."""

    kind = "failure"
    wrong = "{0.where}: {0.reason}"
    #: What a program that anyone may have made said of it: in no report, and on a terminal where it is asked for (-v).
    said: str = ""


class Undecided(Finding, frozen=True):
    """Why nothing could be compared: the reference died, or it has no finite number; ``output`` "*" stands for all."""

    kind = "undecided"
    words = ("decided", "not decided")
    wrong = "not decided: {0.reason}"
    judges = False


class Accepted(Finding, frozen=True):
    """What a consumer's own checker says to a file; ``runtime`` is the release."""

    kind = "accepted"
    words = ("accepted", "refused")
    wrong = "{0.format} is not accepted by {0.runtime}: {0.reason}"


class Played(Accepted, frozen=True):
    """What our model of a release's player does with a file; ``runtime`` is the release."""

    kind = "played"
    words = ("played", "not played")
    wrong = "{0.format} is not played by our model of the player of {0.runtime}: {0.reason}"


class Stated(Finding, frozen=True):
    """What a file states of the interface, beside what the reference states; ``output`` is "interface"."""

    kind = "interface"
    words = ("alike", "differs")
    wrong = "{0.format}: {0.reason}"


class Size(Finding, frozen=True):
    """The bytes of a format beside its budget; ``max_abs_diff`` is what there is too many."""

    kind = "size"
    words = ("kept", "exceeded")
    wrong = "{0.format} is too large: {0.reason}"


_Unanswered = TypeVar("_Unanswered", Failure, Stated, Undecided)


def failure(kind: str, runtime: str, error: RunFailedError, output: str = "*") -> Failure:
    """What a runtime said when it gave no answer."""
    return replace(_without_numbers(Failure, kind, runtime, output, _error_text(error)), said=error.said)


def undecided_reference(kind: str, runtime: str, error: RunFailedError) -> Undecided:
    """A reference that gave no answer: nothing was held against it."""
    text = "; ".join(filter(None, map(str.strip, _error_text(error).splitlines())))  # it goes into the verdict's line
    return undecided_finding(kind, runtime, "*", f"the {kind} gave no answer in {runtime}: {text}")


def _error_text(error: RunFailedError) -> str:
    return (error.what if error.why is None else f"{error.what}: {error.why}").strip()


def undecided_finding(kind: str, runtime: str, output: str, reason: str, where: str | None = None) -> Undecided:
    """What could not be compared, and why."""
    return _without_numbers(Undecided, kind, runtime, output, reason, where)


def stated_finding(kind: str, reason: str) -> Stated:
    """What a file states of the interface otherwise."""
    return _without_numbers(Stated, kind, "file", "interface", reason)


def _without_numbers(
    finding: type[_Unanswered], kind: str, runtime: str, output: str, reason: str, where: str | None = None
) -> _Unanswered:
    infinite = float("inf")
    return finding(
        format=kind,
        runtime=runtime,
        output=output,
        max_abs_diff=infinite,
        max_rel_diff=infinite,
        tolerance=Tolerance(),
        passed=False,
        worst_input=where,
        reason=reason,
    )


def share_text(share: float) -> str:
    """Return a share of what is allowed for a table's cell: 0 where nothing differs."""
    if not math.isfinite(share):
        return "∞"
    return "0" if share == 0 else "<0.01" if share < 0.01 else f"{share:.2f}" if share < 100 else f"{share:.1e}"


def _number(value: float) -> float | str:
    """JSON has no infinities: they are strings."""
    return value if math.isfinite(value) else str(value)


def _rounded_up(value: float) -> str:
    """Three digits, never less than ``value``: who gives it as a tolerance must pass."""
    if value <= 0:
        return "0"
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    text = f"{value:.3g}"
    return text if float(text) >= value else f"{float(text) + digit:.3g}"
