"""The Python interface: the same jobs as the command line, typed results, the same exceptions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from converters.graph.options import CompileOptions
from converters.graph.passes.noise import NoiseMode
from converters.registry import TARGETS
from converters.source import ReadOptions
from exporter.inspection import Inspection, inspect_source
from exporter.parity.report import ParityReport
from exporter.parity.subject import VerifyOptions
from exporter.pipeline import ExportOptions, ExportResult, export, verify_folder
from signatures.errors import ParityError, UsageError
from signatures.roles import Role, parse_role


def _roles(given: Mapping[str, str | Role] | None, flag: str) -> dict[str, Role]:
    roles: dict[str, Role] = {}
    for name, role in (given or {}).items():
        parsed = role if isinstance(role, Role) else parse_role(role)
        if parsed is None:
            known = ", ".join(r.value for r in Role)
            raise UsageError(f"{flag} {name}={role}: there is no such role", fix=f"the roles are {known}")
        roles[name] = parsed
    return roles


def _compile_options(
    names: str,
    noise: str,
    deterministic: bool,
    brain: str | None,
    inputs: Mapping[str, str | Role] | None,
    outputs: Mapping[str, str | Role] | None,
    values: Mapping[str, float] | None,
) -> CompileOptions:
    modes: dict[str, NoiseMode] = {"lift": "lift", "keep": "keep", "zero": "zero"}
    if names not in ("canonical", "source"):
        raise UsageError(f"names={names!r}", fix="one of: canonical, source")
    if noise not in modes:
        raise UsageError(f"noise={noise!r}", fix="one of: lift, keep, zero")
    return CompileOptions(
        names,
        modes[noise],
        deterministic,
        brain,
        _roles(inputs, "--input"),
        _roles(outputs, "--output"),
        dict(values or {}),
    )


def export_model(
    source: Path | str | Sequence[Path | str],
    out: Path | str = "exported",
    *,
    to: str | Sequence[str] = TARGETS,
    name: str | None = None,
    brain: str | None = None,
    names: str = "canonical",
    noise: str = "lift",
    deterministic: bool = False,
    inputs: Mapping[str, str | Role] | None = None,
    outputs: Mapping[str, str | Role] | None = None,
    values: Mapping[str, float] | None = None,
    step: int | None = None,
    opset: int = 15,
    verify: str | Sequence[str] = "auto",
    parity: VerifyOptions | None = None,
    strict: bool = True,
) -> list[ExportResult]:
    """Export every policy of ``source`` (one path or several) to ``out/<policy>/``.

    The parameters are the flags of the command line. Raises ExportModelError and its subclasses; ParityError (after
    everything is written) when formats disagree and ``strict`` is set.
    """
    options = ExportOptions(
        Path(out),
        tuple(t for t in to.split(",") if t) if isinstance(to, str) else tuple(to),
        name,
        _compile_options(names, noise, deterministic, brain, inputs, outputs, values),
        ReadOptions(step),
        opset,
        verify,
        parity or VerifyOptions(),
    )
    sources = [source] if isinstance(source, str | Path) else list(source)
    results = list(export(sources, options))
    failed = [r for r in results if r.passed is False]
    if failed and strict:
        raise ParityError(
            f"{len(failed)} of {len(results)} policies do not agree in all formats",
            report=[r.report.to_dict() for r in failed if r.report is not None],
            where=str(failed[0].folder),
            fix="parity.json in that folder names the outputs, runtimes and inputs",
        )
    return results


def inspect_model(
    source: Path | str,
    *,
    brain: str | None = None,
    inputs: Mapping[str, str | Role] | None = None,
    outputs: Mapping[str, str | Role] | None = None,
    values: Mapping[str, float] | None = None,
) -> Inspection:
    """What is in a source: its policies with their signatures. Raises ExportModelError."""
    return inspect_source(source, _compile_options("canonical", "lift", False, brain, inputs, outputs, values))


def verify_bundle(
    bundle: Path | str,
    *,
    source: Path | str | None = None,
    runtimes: str | Sequence[str] = "auto",
    options: VerifyOptions | None = None,
    allow_unverified: bool = False,
) -> ParityReport:
    """Verify a bundle again. Raises BundleError, RuntimeUnavailableError; a disagreement is ``passed`` False."""
    return verify_folder(
        Path(bundle),
        source=None if source is None else Path(source),
        runtimes=runtimes,
        options=options,
        allow_unverified=allow_unverified,
    )
