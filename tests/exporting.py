"""``export_model`` with every option as a keyword of its own, which is how tests vary one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack

from msgspec.structs import replace

import export_model as public
from export_model.exporter.acting.policy import LoadedPolicy
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


def judged_by(verify: str | Sequence[str] | VerifyOptions, options: VerifyOptions | None = None) -> VerifyOptions:
    return verify if isinstance(verify, VerifyOptions) else replace(options or VerifyOptions(), runtimes=verify)


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
    """Call ``export_model.export``; ``verify`` names the runtimes, ``parity`` has seed, samples and tolerances."""
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    reading = {key: given.pop(key) for key in _ReadKeywords.__annotations__ if key in given}
    return public.export(
        source,
        out,
        to=to,
        for_=for_,
        name=name,
        read=ReadOptions(**reading),
        write=WriteOptions(**given),
        verify=judged_by(verify, parity),
        strict=strict,
        session=session,
        tf_function=tf_function,
        keras_model=keras_model,
    )


def inspect_model(source: Path | str, *, why: bool = False, **options: Unpack[_ReadKeywords]) -> Inspection:
    """Call ``export_model.inspect``."""
    given: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    return public.inspect(source, read=ReadOptions(**given), why=why)


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
    """Call ``export_model.verify``."""
    return public.verify(
        bundle,
        source=source,
        read=ReadOptions(step=step, trust_source=trust_source),
        verify=judged_by(runtimes, options),
        allow_unverified=allow_unverified,
    )


def load_policy(
    source: Path | str, *, runtime: str | None = None, seed: int = 0, brain: str | None = None
) -> LoadedPolicy:
    """Call ``export_model.load``."""
    return public.load(source, read=ReadOptions(brain=brain), runtime=runtime, seed=seed)
