"""What was played, kept in the parity.json of the bundle that it is about."""

from __future__ import annotations

from pathlib import Path

from msgspec.structs import replace

from export_model.converters.files.fetch import read_bytes
from export_model.converters.formats.bundle import bundle
from export_model.exporter.play.report import PlayReport
from export_model.signatures.contract import PARITY, json_of
from export_model.signatures.errors import BundleError
from export_model.signatures.fields import FieldError

_MOST_BYTES = 16 << 20


def keep_record(folder: Path, report: PlayReport) -> PlayReport:
    """Write what was played into a bundle's parity.json, in place of what was played there before; return the report.

    A bundle without one, which was exported without a verification, gets the replay as its own. Where it cannot be
    written, the report that is returned says so.
    """
    try:
        _write_record(folder / PARITY, report)
    except BundleError as error:
        return replace(report, notes=(*report.notes, f"not kept in {PARITY}: {error.message}"))
    return report


def _write_record(file: Path, report: PlayReport) -> None:
    if file.is_file():
        try:
            content = json_of(read_bytes(file, most=_MOST_BYTES))
        except FieldError as error:
            raise BundleError(f"cannot be read: {error}", where=str(file)) from error
        if not isinstance(content, dict):
            raise BundleError("must hold an object", where=str(file))
    else:
        content = report.replay.to_dict()
        content["notes"] = [*content["notes"], f"compared in the states that {report.reference} met when it played"]
    before = content.get("played")
    kept = [r for r in before if isinstance(r, dict)] if isinstance(before, list) else []
    record = report.record.to_dict()
    content["played"] = [*(r for r in kept if r.get("environment") != report.environment), record]
    new = file.with_name(f".{PARITY}.new")
    with bundle.writing(file):
        try:
            new.write_bytes(bundle.dumps(content))
            new.replace(file)
        finally:
            new.unlink(missing_ok=True)
