"""The verdict as one sentence: what was compared with what, out of how many. Every report uses its words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from export_model.converters.formats.registry import KERNELS, WRITTEN
from export_model.converters.runtimes.pool import INDEPENDENT
from export_model.exporter.tables import count_text
from export_model.exporter.verify.excuses import add_forgiven
from export_model.exporter.verify.findings import (
    Accepted,
    Decisions,
    Draws,
    Failure,
    Finding,
    Played,
    Size,
    Stated,
    Undecided,
)

if TYPE_CHECKING:
    from export_model.exporter.verify.report import ParityReport

#: What is held against the reference and is no format that was written.
_APART = ("reference", "golden", "source", "weights")
#: Findings that the verdict tells in words of their own.
_OWN_WORDS = (Accepted, Decisions, Failure, Size, Stated)
_TITLES = {"tensorflow": "TensorFlow"}

#: Why a runtime did not run that is installed.
NOT_ASKED = "not asked for"


def runtime_title(name: str) -> str:
    """Return what people call a runtime."""
    return _TITLES.get(name, name)


def key_of(label: str) -> str:
    """Return the format of a comparison's label: of one signature, or of one file of several."""
    return label.split(" ")[0].partition(":")[0]


def formats_of(report: ParityReport) -> list[str]:
    """Return what was to be compared: the formats that were written, or the files that were given."""
    found = [c.format for c in report.comparisons if c.format not in _APART and not isinstance(c, Size | Stated)]
    return list(dict.fromkeys([*report.sizes, *(_whole(label, report) for label in found)]))


def checked_formats(report: ParityReport) -> list[str]:
    """Return the formats of which an independent runtime gave numbers."""
    ran = {_whole(c.format, report) for c in report.comparisons if c.runtime in INDEPENDENT and _numbers(c)}
    return [label for label in formats_of(report) if label in ran]


def kernel_formats(report: ParityReport) -> list[str]:
    """Return the formats of which this project's kernels alone gave numbers: they read the file back."""
    ran = {_whole(c.format, report) for c in report.comparisons if c.runtime == KERNELS and _numbers(c)}
    return [label for label in unchecked_formats(report) if label in ran]


def unchecked_formats(report: ParityReport) -> list[str]:
    """Return the formats that no independent runtime ran."""
    checked = checked_formats(report)
    return [label for label in formats_of(report) if label not in checked]


def _whole(label: str, report: ParityReport) -> str:
    return label if label in report.sizes else label.partition(":")[0]


def _numbers(found: Finding) -> bool:
    return found.format not in _APART and not isinstance(found, Accepted | Failure | Stated | Undecided | Size)


def verdict(report: ParityReport) -> str:
    """Return the verdict: its word, and what is true of it."""
    says = [c for c in report.comparisons if isinstance(c, Accepted)]
    if report.undecided:
        return f"NOT VERIFIED: {report.undecided}"
    if report.passed is None:
        if says:
            own = kernel_formats(report)
            rest = ", ".join(label for label in unchecked_formats(report) if label not in own)
            by = " and ".join(filter(None, (_checkers(says), _players(says))))
            numbers = f"; no numbers of {rest} were compared in any runtime" if rest else ""
            return f"ACCEPTED by {by}{_by_kernels(report)}{numbers}"
        none = f" {_enumerate_names(unchecked_formats(report))}" if kernel_formats(report) else ""
        return f"NOT VERIFIED: no independent runtime ran{none}{_by_kernels(report)}"
    if not report.passed:
        return f"FAILED: {'; '.join(_wrong(report))}{_drawn_apart(report)}"
    word = "SELF-CONSISTENT" if report.self_consistent else "PASSED"
    if says:
        ran = list(dict.fromkeys(c.runtime for c in report.comparisons if c.runtime in INDEPENDENT and _numbers(c)))
        agrees = f"{', '.join(ran)}: agree{'s' if len(ran) == 1 else ''}, with {reference_text(report)}"
        rest = _remedy(report, report.unchecked, "the rest")
        checked, played = _checkers(says), _players(says)
        accepted = f"{checked}: accepted. " if checked else ""
        plays = f". {played[:1].upper()}{played[1:]}: plays it" if played else ""
        return f"{word}: {accepted}{agrees}{rest}{_drawn_apart(report)}{_left_open(report)}{plays}"
    return f"{word}: {_agreement(report)}{_drawn_apart(report)}{_left_open(report)}"


def reference_text(report: ParityReport) -> str:
    """Return what all was compared with, in words."""
    kind, _, runtime = report.reference.partition("/")
    if report.original is not None or kind == "source":
        return f"the original in {runtime_title(report.original or runtime)}"
    if runtime:
        return f"the bundle's own {WRITTEN[kind].main_of('')}"
    if report.self_consistent:
        return "the original as export-model reads it, which nothing else here can run"
    return "the original as export-model reads it, which was not run"


def _by_kernels(report: ParityReport) -> str:
    """A clause on what this project's own kernels read back, where no other runtime runs it."""
    own = kernel_formats(report)
    if not own:
        return ""
    if report.reference in (f"{label}/{KERNELS}" for label in own):  # itself
        return f"; {_enumerate_names(own)} answered in export-model's own kernels"
    verb = "agrees" if len(own) == 1 else "agree"
    return f"; read back by export-model's own kernels, {_enumerate_names(own)} {verb} with {reference_text(report)}"


def _agreement(report: ParityReport) -> str:
    checked, every = checked_formats(report), formats_of(report)
    what = "formats" if all(label in WRITTEN for label in every) else "files"
    unchecked = unchecked_formats(report)
    rest = _remedy(report, unchecked, "the other" if len(unchecked) == 1 else "the others")
    count = f"{len(checked)} of {len(every)} {what if len(every) > 1 else what[:-1]}{rest}"
    verb = "agrees" if len(checked) == 1 else "agree"
    return f"{', '.join(checked)} ({count}) {verb} with {reference_text(report)}{_rounded_weights_text(report)}"


def _rounded_weights_text(report: ParityReport) -> str:
    """What was compared in which way, where weights were rounded."""
    kept = list(dict.fromkeys(c.runtime for c in report.comparisons if isinstance(c, Decisions)))
    return (
        f": numbers with weights rounded to {_enumerate_names(kept)} there too, decisions with weights as they were"
        if kept
        else ""
    )


def missing_runtimes(report: ParityReport, formats: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return (runtimes to install, runtimes to ask for) that would run ``formats``, as few as possible."""
    left, install, ask = list(formats), list[str](), list[str]()
    here = [n for n, e in report.runtimes.items() if n in INDEPENDENT and e["status"] != "ran"]
    # Where one is installed that was not asked for, it need only be asked.
    here.sort(key=lambda n: report.runtimes[n]["reason"] != NOT_ASKED)
    while left:
        runs = {n: [k for k in left if (f := WRITTEN.get(key_of(k))) and n in f.runtimes] for n in here}
        best = max(runs, key=lambda n: len(runs[n]), default=None)
        if best is None or not runs[best]:
            break
        (ask if report.runtimes[best]["reason"] == NOT_ASKED else install).append(best)
        left = [k for k in left if k not in runs[best]]
    return install, ask


def _remedy(report: ParityReport, unchecked: Sequence[str], others: str) -> str:
    """What would check the others, as a clause."""
    if not unchecked:
        return ""
    install, ask = missing_runtimes(report, unchecked)
    verbs = [f"{verb} {_enumerate_names(names)}" for verb, names in (("install", install), ("ask for", ask)) if names]
    return f"; {' and '.join(verbs)} to check {others}" if verbs else f"; no runtime runs {_enumerate_names(unchecked)}"


def required_reason(report: ParityReport, missing: Sequence[str]) -> str:
    """Return why what was required (``--require``) is not decided."""
    were = "was" if len(missing) == 1 else "were"
    them = "it" if len(missing) == 1 else "them"
    return f"{_enumerate_names(missing)} {were} required, and not checked{_remedy(report, missing, them)}"


def _enumerate_names(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


def _checkers(says: Sequence[Finding]) -> str:
    """Unity's checks that accept it, by release, or the loader whose rules do; empty where none was asked."""
    names = _releases([c for c in says if not isinstance(c, Played)])
    return "" if not names else _loaders(names) or f"Unity's checks ({_release(names)})"


def _loaders(names: Sequence[str]) -> str:
    """The loaders outside Unity among those that were asked."""
    from export_model.converters.consumers.robots.loaders import LOADERS

    return " and ".join(f"the loader rules of {name}" for name in names if name in LOADERS)


def _players(says: Sequence[Finding]) -> str:
    """Our model of the players that play it, by release; empty where none was asked."""
    names = _releases([c for c in says if isinstance(c, Played)])
    return f"our model of Unity's player ({_release(names)})" if names else ""


def _releases(says: Sequence[Finding]) -> list[str]:
    """The releases, 23 for R23 and for R23-2.4, the same release with another engine."""
    majors = [c.runtime.partition("-")[0] for c in says]
    right = [m for m in majors if all(c.passed for c in says if c.runtime.partition("-")[0] == m)]
    return list(dict.fromkeys(name.removeprefix("R") for name in right))


def _release(names: Sequence[str]) -> str:
    return f"release{'s' if len(names) > 1 else ''} {', '.join(names)}"


def _wrong(report: ParityReport) -> list[str]:
    """What is wrong, by kind, and which format stands alone with it."""
    failed = [c for c in report.failures if c.disagrees]
    measured = [c for c in failed if not isinstance(c, _OWN_WORDS)]
    told = []
    if measured:
        count = sum(not isinstance(c, _OWN_WORDS) for c in report.comparisons)
        all_of = count_text(count, "comparison")
        told.append(f"{len(measured)} of {all_of} disagree with {reference_text(report)}{_alone(report)}")
    for kind, words in (
        (Failure, "no answer from {}"),
        (Decisions, "rounded weights decide otherwise: {}"),
        (Played, "not played by our model of Unity's player: {}"),
        (Accepted, "refused by Unity's checks: {}"),
        (Size, "too large: {}"),
        (Stated, "the interface differs: {}"),
    ):
        if kind is Accepted and (by := _loaders([c.runtime for c in failed if type(c) is kind])):
            told.append(f"refused by {by}")
            continue
        names = [_name_in_verdict(c) for c in failed if type(c) is kind]
        told += [words.format(", ".join(dict.fromkeys(names)))] if names else []
    return told


def _name_in_verdict(found: Finding) -> str:
    if isinstance(found, Accepted):
        return found.runtime
    if isinstance(found, Stated):
        return found.reason
    return found.output if isinstance(found, Decisions) else found.format if isinstance(found, Size) else found.where


def _alone(report: ParityReport) -> str:
    """A clause where one format, or one format in one runtime, stands against all others."""
    ran: dict[str, dict[str, bool]] = {}
    for c in report.comparisons:
        if _numbers(c) and not isinstance(c, Decisions):
            runs = ran.setdefault(_whole(c.format, report), {})
            runs[c.runtime] = runs.get(c.runtime, True) and c.passed
    if any(c.format == "reference" and c.disagrees for c in report.comparisons):
        return (
            "; all formats may be right: export-model's own kernels disagree"
            if all(all(r.values()) for r in ran.values())
            else ""
        )
    wrong = [(kind, n) for kind, runs in ran.items() for n, passed in runs.items() if not passed]
    kinds = list(dict.fromkeys(kind for kind, _ in wrong))
    right = [kind for kind, runs in ran.items() if all(runs.values())]
    if len(kinds) != 1:
        return ""
    (kind,) = kinds
    agreeing = [n for n, passed in ran[kind].items() if passed]
    where = f" in {_enumerate_names([n for _, n in wrong])}" if agreeing else ""
    others = [*right, *([f"{kind} in {_enumerate_names(agreeing)}"] if agreeing else [])]
    return (
        f"; {kind}{where} alone differs, {_enumerate_names(others)} agree{'s' if len(others) == 1 else ''}"
        if others
        else ""
    )


def _left_open(report: ParityReport) -> str:
    """A clause on the elements that were held to no number, by the rule that forgave them."""
    forgiven = add_forgiven(c.forgiven for c in report.comparisons)
    count, left = sum(c.elements for c in report.comparisons), [f for f in forgiven if f.excuse.leaves_open]
    told = [f"{f.elements:,} of {count:,} elements left open: {f.excuse.title}" for f in left]
    return "".join(f"; {each}" for each in told)


def _drawn_apart(report: ParityReport) -> str:
    """A clause on what was drawn, and what follows from it, where the source has nothing to hold it against."""
    apart = [c for c in report.comparisons if c.against]
    drawn = list(dict.fromkeys(c.output for c in apart if isinstance(c, Draws)))
    if not drawn:
        return ""
    told = [*dict.fromkeys(c.output for c in apart if c.output not in drawn), f"the draws of {', '.join(drawn)}"]
    return f"; compared between the formats, not with the source: {', '.join(told)}"
