"""``compare_artefacts`` with the keywords that tests give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare import comparison
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport


def compare_artefacts(
    reference: Path | str,
    candidates: Path | str | Sequence[Path | str],
    *,
    names: Mapping[str, str] | None = None,
    runtimes: str | Sequence[str] = "auto",
    options: VerifyOptions | None = None,
    pool: RuntimePool | None = None,
) -> ParityReport:
    """The report, in the processes of ``pool``."""
    judging = replace(options or VerifyOptions(), runtimes=runtimes)
    how = comparison.CompareOptions(names=names or {}, judging=judging)
    return comparison.compare_artefacts(reference, candidates, how, pool=pool)
