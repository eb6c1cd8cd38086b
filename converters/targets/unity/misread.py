"""The constructs of a file that its importer does not read rightly, as findings: most of them give no error at all."""

from __future__ import annotations

from converters.targets.unity.constructs import INPUT, OUTPUT, constructs
from converters.targets.unity.consumers import Consumer
from converters.targets.unity.findings import Finding, Severity
from converters.targets.unity.onnx_file import OnnxFile
from converters.targets.unity.readings import Misreading, Reading, misreadings
from signatures.errors import ExportModelError

_SAYS = {
    Reading.WRONG: "gives other numbers, without an error",
    Reading.REFUSED: "is refused",
    Reading.FAILS: "throws when it runs",
    Reading.LOST: "is left out",
}


def misread(file: OnnxFile, consumer: Consumer) -> tuple[Finding, ...]:
    """One finding per kind of construct, with its places; empty where the shapes of the file contradict each other."""
    if file.has_negative_lengths:
        return ()  # ONNX's shape inference would abort the process
    try:
        model = constructs(file.model)
    except (ExportModelError, ValueError, TypeError, LookupError):
        return ()
    found: dict[tuple[Reading, str, str], list[str]] = {}
    for reading in misreadings(model, [consumer.runtime]):
        found.setdefault(_kind(reading), []).append(reading.construct.name)
    return tuple(
        Finding(
            Severity.ERROR,
            f"{op} {_SAYS[kind]}: {says}",
            _places(names),
            f"--for {consumer.profile} writes it in a form that {consumer.runtime} reads",
        )
        for (kind, op, says), names in found.items()
    )


def _kind(found: Misreading) -> tuple[Reading, str, str]:
    op = {INPUT: "an input", OUTPUT: "an output"}.get(found.construct.op, found.construct.op)
    return found.rule.reading, op, found.rule.says


def _places(names: list[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
