"""``--tolerances FILE``: a user's tolerances as data, each with its reason.

TOML, or JSON of the same shape::

    [[tolerance]]
    output = "value_estimate"     # any of output, runtime, format, policy; what is left out stands for all
    runtime = "tfjs-webgl"
    atol = 1e-3                   # one of atol, rtol or both; the other is 1e-5
    reason = "WebGL on phones computes in float16"

The last entry that covers a comparison decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.exporter.options_file import read_options
from export_model.exporter.verify.tolerances import Tolerance, ToleranceRule
from export_model.signatures.errors import UsageError

_KEYS = frozenset({"policy", "format", "runtime", "output", "atol", "rtol", "reason"})
#: What a float holds; a number of TOML or JSON may have any number of digits.
_LARGEST = 1e300
_FIX = "each [[tolerance]] has a reason, atol or rtol or both, and any of output, runtime, format, policy"


def read_tolerances(path: Path) -> tuple[ToleranceRule, ...]:
    """The rules of a file. Raises UsageError that names the entry where one is not complete."""
    try:
        content = read_options(path, str(path), toml=path.suffix.lower() != ".json")
    except (ValueError, RecursionError) as error:
        raise UsageError(
            "is neither TOML nor JSON", where=str(path), why=str(error), fix="a name that ends in .json is read as JSON"
        ) from error
    entries = content.get("tolerance") if isinstance(content, dict) else None
    if not isinstance(entries, list) or set(content) != {"tolerance"}:
        raise UsageError("must hold a list called tolerance and nothing else", where=str(path), fix=_FIX)
    return tuple(_rule(entry, f"{path}, tolerance {n}") for n, entry in enumerate(entries, 1))


def _rule(entry: Any, where: str) -> ToleranceRule:
    if not isinstance(entry, Mapping):
        raise UsageError("is not a table", where=where, fix=_FIX)
    unknown = sorted(set(entry) - _KEYS)
    if unknown:
        raise UsageError(f"has an unknown key {unknown[0]!r}", where=where, fix=_FIX)
    reason = entry.get("reason")
    if not isinstance(reason, str) or not reason.strip():
        raise UsageError("gives no reason", where=where, why="a tolerance other than the default needs one", fix=_FIX)
    known = {"format": [*WRITTEN, "reference"], "runtime": [r.name for r in RUNTIMES]}
    for key in ("policy", "format", "runtime", "output"):
        value = entry.get(key)
        if value is not None and (not isinstance(value, str) or not value):
            raise UsageError(f"{key} must be a name", where=where, fix=_FIX)
        if value is not None and value not in known.get(key, [value]):
            raise UsageError(f"unknown {key} {value!r}", where=where, fix=f"one of: {', '.join(known[key])}")
    bounds = {key: entry[key] for key in ("atol", "rtol") if key in entry}
    if not bounds:
        raise UsageError("gives neither atol nor rtol", where=where, fix=_FIX)
    for key, bound in bounds.items():
        if isinstance(bound, bool) or not isinstance(bound, int | float) or not 0 <= bound <= _LARGEST:
            raise UsageError(f"{key} is {str(bound)[:40]}", where=where, fix="give a number that is not negative")
    tolerance = Tolerance(**{key: float(bound) for key, bound in bounds.items()}, reason=" ".join(reason.split()))
    return ToleranceRule(tolerance, *(entry.get(key) for key in ("policy", "format", "runtime", "output")))
