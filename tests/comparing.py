"""``compare_artefacts`` with the keywords that tests give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec.structs import replace

from converters.runtimes.pool import RuntimePool
from exporter.compare import comparison
from exporter.verify.options import VerifyOptions
from exporter.verify.report import ParityReport


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
