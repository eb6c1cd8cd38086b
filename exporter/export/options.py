"""What a person says of an export, checked: the same for the command line and for Python."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from msgspec import Struct, field

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.labels import Labels
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import UsageError


class ExportOptions(Struct, frozen=True):
    """What ``export-model`` may be told; see the command line for the meaning of each."""

    out: Path = Path("exported")
    #: None: the usual ones, or what the consumer of ``profile`` loads
    targets: Sequence[str] | None = None
    name: str | None = None
    compile: CompileOptions = field(default_factory=CompileOptions)
    read: ReadOptions = field(default_factory=ReadOptions)
    #: None: 15, or the consumer's
    opset: int | None = None
    verify: str | Sequence[str] = "auto"
    parity: VerifyOptions = field(default_factory=VerifyOptions)
    labels: Labels | None = None
    #: the consumer that the files are made for (``--for``)
    profile: str | None = None
    #: what weights are rounded to and kept in (``--dtype``, ``--quantize``)
    weights: Storage = "float32"
    #: for how many agents the files are (``--batch``; None: for any number)
    batch: int | None = None
    #: how source code is written (``--math``, ``--weights``, ``--outputs``, ``--guard``)
    code: CodeOptions = CodeOptions()
    #: what of the interface the graph computes (``--bake``): ``actions``, or None
    bake: str | None = None


def storage(dtype: str, quantize: str | None) -> Storage:
    """What weights are kept in. Raises UsageError."""
    if dtype != "float32" and quantize is not None:
        raise UsageError(f"--dtype {dtype} and --quantize {quantize} contradict each other", fix="give one of them")
    return storage_of(
        dtype if quantize is None else quantize, ("float32", "float16") if quantize is None else ("int8",)
    )


def storage_of(name: str, known: Sequence[Storage] = get_args(Storage)) -> Storage:
    """One of those that are known. Raises UsageError."""
    for storage in known:
        if storage == name:
            return storage
    raise UsageError(f"weights are not kept in {name!r}", fix=f"one of: {', '.join(known)}")
