"""Every policy at hand as a .tflite: what is written, what acts alike in LiteRT, what comes back byte for byte.

``python -m tests.figures --litert`` writes the counts into docs/figures.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from converters.formats.format import WriteOptions
from converters.formats.registry import WRITTEN
from converters.formats.source import ReadOptions
from converters.policy.policy import Policy
from converters.runtimes.pool import RuntimePool
from exporter.export.job import contract_of
from exporter.export.pipeline import ExportOptions, export
from exporter.export.sources import read_source
from exporter.verify.options import VerifyOptions
from signatures.contract import safe_name
from signatures.errors import ExportModelError

RUNTIMES = ("litert", "litert-plain")


def written(policy: Policy, text: str) -> bytes:
    """The file of a policy under a contract. Raises UnsupportedOpError."""
    (pieces,) = WRITTEN["litert"].artifact(policy, WriteOptions(text)).files.values()
    return pieces.to_bytes()


def write_again(file: Path, text: str) -> bytes:
    """What is written of a file that is read, under the same contract. Raises ExportModelError."""
    (policy,) = read_source(file).policies()
    return written(policy, text)


def round_trips(source: Path, folder: Path) -> Iterator[tuple[bytes, bytes]]:
    """Of each policy its file, and what is written of that file. Raises ExportModelError."""
    found, place = read_source(source), folder / "policy.tflite"
    for model, policy in found.compile_models(None):
        named = replace(policy, name=safe_name(policy.name))
        text = contract_of(named, found, model, ReadOptions()).compact()
        place.write_bytes(written(named, text))
        yield place.read_bytes(), write_again(place, text)


def sweep(files: Sequence[Path], pool: RuntimePool) -> dict[str, Any]:
    """The counts, as JSON."""
    counts: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    failed: list[str] = []
    for number, file in enumerate(files, 1):
        print(f"{number} of {len(files)}: {file.name}", file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory() as scratch:
            try:
                known = list(export([file], ExportOptions(Path(scratch, "onnx"), ("onnx",), verify="none")))
            except ExportModelError:
                continue
            counts["files"] += 1
            counts["onnx"] += len(known)
            options = ExportOptions(Path(scratch, "litert"), ("litert",), verify=RUNTIMES, parity=VerifyOptions(seed=3))
            try:
                results = list(export([file], options, pool=pool))
            except ExportModelError as error:
                refused[error.what] += len(known)
                continue
            counts["written"] += len(results)
            for result in results:
                agrees = result.report is not None and result.report.passed is True
                counts["agree"] += agrees
                if not agrees:
                    failed.append(f"{file.parent.name}/{result.policy.name}")
            counts["same"] += sum(first == second for first, second in round_trips(file, Path(scratch)))
    return {**counts, "refused": dict(refused), "failed": failed}
