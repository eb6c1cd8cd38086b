"""The functions of ``exporter``: those of ``export_model`` with every option as a keyword of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.source import ReadOptions as FileOptions
from export_model.exporter import interface
from export_model.exporter.compare import comparison
from export_model.exporter.export.labels import Labels
from export_model.exporter.export.pipeline import ExportResult
from export_model.exporter.inspect.inspection import Inspection
from export_model.exporter.options import ReadOptions, WriteOptions
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.roles import Role


class _ReadKeywords(TypedDict, total=False):
    """The fields of ReadOptions; None is as if left out."""

    step: int | None
    brain: str | None
    inputs: Mapping[str, str | Role] | None
    outputs: Mapping[str, str | Role] | None
    values: Mapping[str, float] | None
    sensors: Sequence[Sequence[int]]
    goals: Sequence[int]
    activation: str | None
    script: str | None
    repair: str | None
    normaliser: Path | str | None
    interface: Path | str | None
    trust_source: bool


class _Keywords(_ReadKeywords, total=False):
    """With those of WriteOptions that no field of ReadOptions is called like."""

    names: str | None
    noise: str | None
    deterministic: bool
    opset: int | None
    dtype: str
    quantize: str | None
    batch: int | None
    math: str
    weights: str
    guard: float | None
    bake: str | None
    labels: Labels | None


def export_model(
    source: Path | str | Sequence[Path | str] | None = None,
    out: Path | str = "exported",
    *,
    session: Any = None,
    tf_function: Any = None,
    keras_model: Any = None,
    to: str | Sequence[str] | None = None,
    name: str | None = None,
    verify: str | Sequence[str] = "auto",
    parity: VerifyOptions | None = None,
    strict: bool = True,
    for_: str | None = None,
    **options: Unpack[_Keywords],
) -> list[ExportResult]:
    """Export every policy of a source to ``out/<policy>/``, and compare what was written in the installed runtimes.

    ``export_model.export`` with flat keywords: ``options`` are those of ReadOptions (``brain``, ``inputs``,
    ``outputs``, ``values``, ``step``, ``sensors`` …) and of WriteOptions (``names``, ``noise``, ``opset`` …).
    ``verify`` names the runtimes, ``parity`` has seed, samples and tolerances. Raises ExportModelError and its
    subclasses::

        (result,) = export_model("3DBall.bytes", "out", to="onnx,tfjs")
        print(result.passed, result.folder, result.policy.signature.inputs)
    """
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    reading = {key: given.pop(key) for key in _ReadKeywords.__annotations__ if key in given}
    return interface.export(
        source,
        out,
        to=to,
        for_=for_,
        name=name,
        read=ReadOptions(**reading),
        write=WriteOptions(**given),
        verify=interface.judged_by(verify, parity),
        strict=strict,
        session=session,
        tf_function=tf_function,
        keras_model=keras_model,
    )


def inspect_model(source: Path | str, *, why: bool = False, **options: Unpack[_ReadKeywords]) -> Inspection:
    """Return the policies of a source with their signatures: ``export_model.inspect`` with flat keywords.

    ``options`` are those of ReadOptions. ``why``: each policy has its ``decisions``, which rule decided what a tensor
    is for. Raises ExportModelError::

        for found in inspect_model("results/first_run").policies:
            print(found.policy.name, found.policy.signature.inputs, found.targets)
    """
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    return interface.inspect(source, read=ReadOptions(**given), why=why)


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
    """Verify a bundle again: ``export_model.verify`` with flat keywords.

    - ``source``: what it was exported from, to compare with that; else a file of the bundle is the reference. ``step``:
      the checkpoint of the source (default: that of the export).
    - ``runtimes``: ``"auto"``, ``"full"``, ``"browser"``, or runtimes by name; ``options``: seed, samples, tolerances.
    - ``allow_unverified``: no error where no independent runtime is installed.

    Raises BundleError, RuntimeUnavailableError; a disagreement is not raised, ``passed`` is False::

        report = verify_bundle("out/3DBall", source="3DBall.bytes", runtimes=["onnxruntime"])
        print(report.verdict, report.failures)
    """
    return interface.verify(
        bundle,
        source=source,
        read=ReadOptions(step=step, trust_source=trust_source),
        verify=interface.judged_by(runtimes, options),
        allow_unverified=allow_unverified,
    )


def compare_artefacts(
    reference: Path | str,
    candidates: Path | str | Sequence[Path | str],
    *,
    names: Mapping[str, str] | None = None,
    runtimes: str | Sequence[str] = "auto",
    options: VerifyOptions | None = None,
    understanding: CompileOptions | None = None,
    read: FileOptions | None = None,
    allow_unverified: bool = False,
) -> ParityReport:
    """Compare files that any tool made with a reference: ``export_model.compare`` with flat keywords.

    - ``names``: a name of the reference → what the candidates call it.
    - ``runtimes``: as in ``verify_bundle``; ``options``: seed, samples, tolerances.
    - ``understanding``, ``read``: how to read the reference.

    Raises ExportModelError::

        report = compare_artefacts("3DBall.bytes", "theirs.onnx", names={"action": "Identity"})
        assert report.passed, report.failures
    """
    how = comparison.CompareOptions(
        names=names or {},
        judging=interface.judged_by(runtimes, options),
        understanding=understanding,
        read=read,
        allow_unverified=allow_unverified,
    )
    return comparison.compare_artefacts(reference, candidates, how)
