"""The Python interface: the same jobs as the command line, typed results, the same exceptions."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from converters.formats.source import ReadOptions
from exporter.export.again import verify_folder
from exporter.export.labels import Labels
from exporter.export.options import ExportOptions, compile_options, storage
from exporter.export.pipeline import ExportResult, export
from exporter.export.sources import Source, live_source
from exporter.inspect.inspection import Inspection, inspect_source
from exporter.remote.fetching import nearby
from exporter.verify.options import VerifyOptions
from exporter.verify.report import ParityReport
from signatures.errors import ParityError, UsageError
from signatures.roles import Role

_LOG = logging.getLogger(__name__)


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
    goals: Sequence[int] = (),
    activation: str | None = None,
    opset: int | None = None,
    verify: str | Sequence[str] = "auto",
    parity: VerifyOptions | None = None,
    labels: Labels | None = None,
    strict: bool = True,
    for_: str | None = None,
    dtype: str = "float32",
    quantize: str | None = None,
    batch: int | None = None,
) -> list[ExportResult]:
    """Export every policy of a source to ``out/<policy>/``, and compare what was written in the runtimes that are here.

    What to export, exactly one of:

    - ``source``: a path, or several.
    - ``session``: the tf.compat.v1.Session that the policy was trained in; ``tf_function``: a tf.function that has an
      ``input_signature`` (or was traced once), or a ConcreteFunction; ``keras_model``. Nothing of a live object is
      changed. Its policy is called ``policy``, or as the function or the model is.

    What to write:

    - ``to``: formats, as a list or as ``"onnx,tfjs"`` (default: all but ``nn``, or what ``for_`` loads); ``for_``: the
      consumer that the files are made for (``--for``).
    - ``name``: the policy's name (of a single one); ``brain``: only this brain of a graph that holds several.
    - ``names``: ``"canonical"``, or ``"source"`` for the trainer's own tensor names.
    - ``noise``: noise drawn in the graph becomes an input (``"lift"``), stays (``"keep"``) or is removed (``"zero"``);
      ``deterministic``: ``action`` is the deterministic one.
    - ``opset``: of ONNX (default: 15, or what ``for_`` loads); ``labels``: names of observations and actions, a file or
      a mapping.
    - ``dtype``: ``"float16"`` keeps weights in half the bytes, ``quantize``: ``"int8"`` in a quarter; computed is in
      float32, and verification says how many decisions become other ones.
    - ``batch``: ONNX and LiteRT files for so many agents at a time (default: for any number).

    How to read it:

    - ``inputs``, ``outputs``: name → role, where it cannot be told from the graph; ``values``: placeholder → number.
    - ``step``: a run's checkpoint (default: the newest); ``sensors`` (``goals``: which of them),
      ``activation``: what a ``.pt`` does not tell.
    - ``trust_source``: let Keras load what is not read as data; it can run code.

    How to verify:

    - ``verify``: ``"auto"``, ``"full"``, ``"browser"``, ``"none"``, or runtimes by name.
    - ``parity``: seed, samples, tolerances; ``strict``: raise ParityError, after everything is written, when formats
      disagree. Without it the result says so: ``passed`` is False.

    Raises ExportModelError and its subclasses::

        (result,) = export_model("3DBall.bytes", "out", to="onnx,tfjs")
        print(result.passed, result.folder, result.policy.signature.inputs)
    """
    options = ExportOptions(
        Path(out),
        [t for t in to.split(",") if t] if isinstance(to, str) else to,
        name,
        compile_options(names, noise, deterministic, brain, inputs, outputs, values),
        ReadOptions(step, tuple(tuple(s) for s in sensors), trust_source, tuple(goals), activation),
        opset,
        verify,
        parity or VerifyOptions(),
        labels,
        for_,
        storage(dtype, quantize),
        batch,
    )
    live = {"session": session, "tf_function": tf_function, "keras_model": keras_model}
    with _sources(source, live, step) as sources:
        results = []
        for result in export(sources, options, _LOG.info):
            results.append(result)
            _LOG.info("%r", result)
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
    goals: Sequence[int] = (),
    activation: str | None = None,
    why: bool = False,
) -> Inspection:
    """What is in a source: its policies with their signatures. Nothing is written.

    The parameters are those of ``export_model``; ``why``: each policy has its ``decisions``, which rule decided what a
    tensor is for. Raises ExportModelError::

        for found in inspect_model("results/first_run").policies:
            print(found.policy.name, found.policy.signature.inputs, found.targets)
    """
    options = compile_options("canonical", "lift", False, brain, inputs, outputs, values)
    read = ReadOptions(step, tuple(tuple(s) for s in sensors), trust_source, tuple(goals), activation)
    with nearby(Path(source)) as here:
        return inspect_source(here, options, read, why=why)


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
    """Verify a bundle again: first the hashes of its files, then every format in the runtimes that are here.

    - ``source``: what it was exported from, to compare with that; else its own ``.bytes`` is the reference. ``step``:
      the checkpoint of the source (default: that of the export).
    - ``runtimes``: ``"auto"``, ``"full"``, ``"browser"``, or runtimes by name; ``options``: seed, samples, tolerances.
    - ``allow_unverified``: no error where no independent runtime is installed.

    Raises BundleError, RuntimeUnavailableError; a disagreement is not raised, ``passed`` is False::

        report = verify_bundle("out/3DBall", source="3DBall.bytes", runtimes=["onnxruntime"])
        print(report.verdict, report.failures)
    """
    with ExitStack() as fetched:
        return verify_folder(
            fetched.enter_context(nearby(Path(bundle))),
            source=None if source is None else fetched.enter_context(nearby(Path(source))),
            step=step,
            trust_source=trust_source,
            runtimes=runtimes,
            options=options,
            allow_unverified=allow_unverified,
            progress=_LOG.info,
        )
