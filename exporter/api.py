"""The Python interface: the same jobs as the command line, typed results, the same exceptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from converters.graph.options import CompileOptions, NoiseMode
from converters.source import ReadOptions
from exporter.export.labels import Labels
from exporter.export.pipeline import ExportOptions, ExportResult, export, verify_folder
from exporter.export.sources import Source, live_source
from exporter.inspect.inspection import Inspection, inspect_source
from exporter.verify.options import VerifyOptions
from exporter.verify.report import ParityReport
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
    source: Path | str | Sequence[Path | str] | None = None,
    out: Path | str = "exported",
    *,
    session: Any = None,
    tf_function: Any = None,
    keras_model: Any = None,
    to: str | Sequence[str] | None = None,
    name: str | None = None,
    brain: str | None = None,
    names: str = "canonical",
    noise: str = "lift",
    deterministic: bool = False,
    inputs: Mapping[str, str | Role] | None = None,
    outputs: Mapping[str, str | Role] | None = None,
    values: Mapping[str, float] | None = None,
    step: int | None = None,
    sensors: Sequence[Sequence[int]] = (),
    trust_source: bool = False,
    opset: int | None = None,
    verify: str | Sequence[str] = "auto",
    parity: VerifyOptions | None = None,
    labels: Labels | None = None,
    strict: bool = True,
    for_: str | None = None,
) -> list[ExportResult]:
    """Export every policy of a source to ``out/<policy>/``.

    The source is one of: ``source``, one path or several; in a training script, ``session``, the tf.compat.v1.Session
    that the policy was trained in; ``tf_function``, a tf.function that has an ``input_signature`` (or was traced once),
    or a ConcreteFunction; ``keras_model``. Nothing of a live object is changed. Its policy is called ``policy``, or as
    the function or the model is; ``name`` gives another.

    ``for_`` names the consumer that the files are made for (``--for``); ``to`` and ``opset`` are by default what it
    loads, without it all formats but ``nn`` and opset 15. The other parameters are the flags of the
    command line. Raises ExportModelError and its subclasses; ParityError (after everything is written) when formats
    disagree and ``strict`` is set.
    """
    options = ExportOptions(
        Path(out),
        [t for t in to.split(",") if t] if isinstance(to, str) else to,
        name,
        _compile_options(names, noise, deterministic, brain, inputs, outputs, values),
        ReadOptions(step, tuple(tuple(s) for s in sensors), trust_source),
        opset,
        verify,
        parity or VerifyOptions(),
        labels,
        for_,
    )
    live = {"session": session, "tf_function": tf_function, "keras_model": keras_model}
    with _sources(source, live, step) as sources:
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


@contextmanager
def _sources(
    source: Path | str | Sequence[Path | str] | None, objects: Mapping[str, Any], step: int | None
) -> Iterator[Sequence[Path | str | Source]]:
    """What the pipeline is given, for as long as the context lasts. Raises UsageError unless there is one source."""
    live = {key: given for key, given in objects.items() if given is not None}
    given = [*(["source"] if source is not None else []), *live]
    if len(given) != 1:
        raise UsageError(
            f"{' and '.join(given)} were given" if given else "no source was given",
            fix=f"give one of: source, {', '.join(objects)}",
        )
    if source is not None:
        yield [source] if isinstance(source, str | Path) else list(source)
        return
    if step is not None:
        raise UsageError(f"step={step} goes with a folder", fix=f"leave it out: {given[0]} has the values of now")
    with live_source(given[0], live[given[0]]) as found:
        yield [found]


def inspect_model(
    source: Path | str,
    *,
    brain: str | None = None,
    inputs: Mapping[str, str | Role] | None = None,
    outputs: Mapping[str, str | Role] | None = None,
    values: Mapping[str, float] | None = None,
    step: int | None = None,
    sensors: Sequence[Sequence[int]] = (),
    trust_source: bool = False,
) -> Inspection:
    """What is in a source: its policies with their signatures. Raises ExportModelError.

    ``step`` asks for a checkpoint of a run's folder; the default is what an export would take. ``sensors`` are the
    shapes that a ``.pt`` does not tell.
    """
    options = _compile_options("canonical", "lift", False, brain, inputs, outputs, values)
    return inspect_source(source, options, ReadOptions(step, tuple(tuple(s) for s in sensors), trust_source))


def verify_bundle(
    bundle: Path | str,
    *,
    source: Path | str | None = None,
    step: int | None = None,
    trust_source: bool = False,
    runtimes: str | Sequence[str] = "auto",
    options: VerifyOptions | None = None,
    allow_unverified: bool = False,
) -> ParityReport:
    """Verify a bundle again. Raises BundleError, RuntimeUnavailableError; a disagreement is ``passed`` False.

    ``step`` says which checkpoint of ``source`` it was exported from; the default is the step of the export.
    """
    return verify_folder(
        Path(bundle),
        source=None if source is None else Path(source),
        step=step,
        trust_source=trust_source,
        runtimes=runtimes,
        options=options,
        allow_unverified=allow_unverified,
    )
