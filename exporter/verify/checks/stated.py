"""What files state of their numbers beside the contract: an ONNX's metadata, the comment of source code."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from export_model.converters.formats.format import Format
from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.verify.findings import Finding, stated_finding
from export_model.signatures.contract import json_of, parse
from export_model.signatures.spec import PolicySignature


def check_stated(files: Mapping[str, Path], signature: PolicySignature) -> Iterator[Finding]:
    """A finding for each file (by format) that states otherwise than the policy's signature. Raises SourceError."""
    for key, path in files.items():
        misstatement = WRITTEN[key].misstatement
        if misstatement is not None and (what := misstatement(path, signature)) is not None:
            yield stated_finding(key, what)


def check_own(label: str, form: Format, path: Path) -> Iterator[Finding]:
    """A finding where a file of ours states otherwise than the contract in it. Raises SourceError, DamagedFileError."""
    text = None if form.held is None or form.misstatement is None else form.held(path)
    if text is not None and form.misstatement is not None:
        what = form.misstatement(path, parse(json_of(text)).signature)
        if what is not None:
            yield stated_finding(label, f"{what}, and its contract says otherwise")
