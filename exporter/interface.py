"""``import export_model``: the jobs of the command line as functions, with typed results and the same exceptions."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from export_model.exporter.acting.loading import load_policy
from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.compare.comparison import CompareOptions, compare_artefacts
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.options import ExportOptions, storage
from export_model.exporter.export.pipeline import ExportResult
from export_model.exporter.export.pipeline import export as run_export
from export_model.exporter.export.sources import Source, live_source
from export_model.exporter.fleet.sources import in_folder
from export_model.exporter.inspect.inspection import Inspection, inspect_source
from export_model.exporter.options import ReadOptions, WriteOptions, compile_options
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.play import play_policy
from export_model.exporter.play.report import PlayReport
from export_model.exporter.play.worlds import MakeWorld
from export_model.exporter.remote.fetching import nearby
from export_model.exporter.tables import count_text
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.code import code_options
from export_model.signatures.errors import ParityError, UsageError

# What a program logs is found under the package's name, whichever module does the job.
_LOG = logging.getLogger("export_model")


def export(
    source: Path | str | Sequence[Path | str] | None = None,
    out: Path | str = "exported",
    *,
    to: str | Sequence[str] | None = None,
    for_: str | None = None,
    name: str | None = None,
    read: ReadOptions | None = None,
    write: WriteOptions | None = None,
    verify: str | Sequence[str] | VerifyOptions = "auto",
    strict: bool = True,
    session: Any = None,
    tf_function: Any = None,
    keras_model: Any = None,
) -> list[ExportResult]:
    """Export every policy of a source to ``out/<policy>/``, and compare what was written in the installed runtimes.

    What to export, exactly one of:

    - ``source``: a path, or several.
    - ``session``: the tf.compat.v1.Session that the policy was trained in; ``tf_function``: a tf.function that has an
      ``input_signature`` (or was traced once), or a ConcreteFunction; ``keras_model``. Live objects are not changed.

    How:

    - ``to``: formats, as a list or as ``"onnx,tfjs"`` (default: the usual four, or those that ``for_`` loads).
    - ``for_``: the consumer that the files are made for (``--for``).
    - ``name``: the policy's name, where the source has one policy.
    - ``read``, ``write``: how to read the source and how to write the files.
    - ``verify``: ``"auto"``, ``"full"``, ``"browser"``, ``"none"``, runtimes by name, or VerifyOptions.
    - ``strict``: raise ParityError, after everything is written, when formats disagree. Without it ``passed`` is False.

    Raises ExportModelError and its subclasses::

        (result,) = export_model.export("3DBall.bytes", "out", to="onnx,tfjs")
        print(result.passed, result.folder, result.policy.signature.inputs)
    """
    read, write, judging = read or ReadOptions(), write or WriteOptions(), _judged_by(verify)
    options = ExportOptions(
        out=Path(out),
        targets=[t for t in to.split(",") if t] if isinstance(to, str) else to,
        name=name,
        compile=compile_options(read, write),
        read=read.for_reader(),
        opset=write.opset,
        verify=judging.runtimes,
        parity=judging,
        labels=write.labels,
        profile=for_,
        weights=storage(write.dtype, write.quantize),
        batch=write.batch,
        code=code_options(write.math, write.weights, write.outputs, write.guard),
        bake=write.bake,
    )
    live = {"session": session, "tf_function": tf_function, "keras_model": keras_model}
    with _sources(source, live, options) as sources:
        results = []
        for result in run_export(sources, options, _LOG.info):
            results.append(result)
            _LOG.info("%r", result)
    failed = [r for r in results if r.passed is False]
    if failed and strict:
        raise ParityError(
            f"the formats of {len(failed)} of {count_text(len(results), 'policy', 'policies')} disagree",
            report=[r.report.to_dict() for r in failed if r.report is not None],
            where=str(failed[0].folder),
            fix="parity.json in that folder names the outputs, runtimes and inputs",
        )
    return results


def _judged_by(verify: str | Sequence[str] | VerifyOptions) -> VerifyOptions:
    """Return the options of a verification that was asked for by runtimes or by options."""
    return verify if isinstance(verify, VerifyOptions) else VerifyOptions(runtimes=verify)


@contextmanager
def _sources(
    source: Path | str | Sequence[Path | str] | None, objects: Mapping[str, Any], options: ExportOptions
) -> Iterator[Sequence[Path | str | Source]]:
    """Yield what the pipeline takes, of a folder what it stands for. Raises UsageError unless there is one source."""
    live = {key: value for key, value in objects.items() if value is not None}
    names = [*(["source"] if source is not None else []), *live]
    if len(names) != 1:
        raise UsageError(
            f"{' and '.join(names)} were given" if names else "no source was given",
            fix=f"give one of: source, {', '.join(objects)}",
        )
    if source is not None:
        given = [source] if isinstance(source, str | Path) else source
        yield [one for path in given for one in in_folder(Path(path), options.out, options.read)]
        return
    if (step := options.read.step) is not None:
        raise UsageError(f"step={step} goes with a folder", fix=f"leave it out: {names[0]} has the values of now")
    with live_source(names[0], live[names[0]]) as opened:
        yield [opened]


def load(
    source: Path | str, *, read: ReadOptions | None = None, runtime: str | None = None, seed: int = 0
) -> LoadedPolicy:
    """Load a policy that acts in this process.

    - ``source``: a bundle, or anything that can be exported (an ``.onnx``, a ``.bytes``, a run's folder): that is
      converted in memory, and nothing is written. ``read``: as for ``export``.
    - ``runtime``: ``onnxruntime`` or ``numpy`` (slower; the base install has it). Without it, the first of these that
      is installed and that a bundle has the file of (``.onnx``, ``.bytes``).
    - ``seed`` starts the draws: the same seed gives the same actions.

    Raises ExportModelError::

        policy = export_model.load("exported/3DBall")
        action = policy.decide(observation, deterministic=True).action
    """
    read = read or ReadOptions()
    return load_policy(Path(source), runtime, seed, compile_options(read), read.for_reader())


def inspect(source: Path | str, *, read: ReadOptions | None = None, why: bool = False) -> Inspection:
    """Return the policies of a source with their signatures. Nothing is written.

    ``why``: each policy has its ``decisions``, which rule decided what a tensor is for. Raises ExportModelError::

        for found in export_model.inspect("results/first_run").policies:
            print(found.policy.name, found.policy.signature.inputs, found.targets)
    """
    read = read or ReadOptions()
    with nearby(Path(source)) as here:
        return inspect_source(here, compile_options(read), read.for_reader(), why=why)


def verify(
    bundle: Path | str,
    *,
    source: Path | str | None = None,
    read: ReadOptions | None = None,
    verify: str | Sequence[str] | VerifyOptions = "auto",
    allow_unverified: bool = False,
) -> ParityReport:
    """Verify a bundle again: first the hashes of its files, then every format in the installed runtimes.

    - ``source``: what it was exported from, to compare with that; else a file of the bundle is the reference. ``read``:
      of it, ``step`` and ``trust_source``.
    - ``verify``: as for ``export``.
    - ``allow_unverified``: no error where no independent runtime is installed.

    Raises BundleError, RuntimeUnavailableError; a disagreement is not raised, ``passed`` is False::

        report = export_model.verify("out/3DBall", source="3DBall.bytes", verify=["onnxruntime"])
        print(report.verdict, report.failures)
    """
    read, judging = read or ReadOptions(), _judged_by(verify)
    with ExitStack() as fetched:
        return verify_folder(
            fetched.enter_context(nearby(Path(bundle))),
            source=None if source is None else fetched.enter_context(nearby(Path(source))),
            step=read.step,
            trust_source=read.trust_source,
            runtimes=judging.runtimes,
            options=judging,
            allow_unverified=allow_unverified,
            progress=_LOG.info,
        )


def compare(
    reference: Path | str,
    candidates: Path | str | Sequence[Path | str],
    *,
    names: Mapping[str, str] | None = None,
    read: ReadOptions | None = None,
    candidate_read: ReadOptions | None = None,
    verify: str | Sequence[str] | VerifyOptions = "auto",
    allow_unverified: bool = False,
) -> ParityReport:
    """Compare files that any tool made with a reference; every format of a candidate that is a bundle takes part.

    - ``names``: a name of the reference → what the candidates call it, where their roles do not tell.
    - ``read``: how to read the reference; ``candidate_read``: the candidates; ``verify``: as for ``export``.
    - ``allow_unverified``: no error where none of the candidates' runtimes is installed.

    Raises ExportModelError::

        report = export_model.compare("3DBall.bytes", "theirs.onnx", names={"action": "Identity"})
        assert report.passed, report.failures
    """
    read = read or ReadOptions()
    options = CompareOptions(
        names=names or {},
        judging=_judged_by(verify),
        understanding=compile_options(read),
        read=read.for_reader(),
        candidate_understanding=None if candidate_read is None else compile_options(candidate_read),
        candidate_read=None if candidate_read is None else candidate_read.for_reader(),
        allow_unverified=allow_unverified,
    )
    return compare_artefacts(reference, candidates, options)


def play(
    reference: Path | str,
    env: str | MakeWorld,
    candidates: Path | str | Sequence[Path | str] = (),
    *,
    options: PlayOptions | None = None,
    partner: Path | str | None = None,
    names: Mapping[str, str] | None = None,
    read: ReadOptions | None = None,
    verify: str | Sequence[str] | VerifyOptions = "auto",
) -> PlayReport:
    """Play an environment with every format in the installed runtimes, and compare what they earn.

    Each is fed the states that the reference met, step by step; then each plays whole episodes from the same seeds.

    - ``reference``, ``candidates``: as for ``compare``. Without candidates the formats of the bundle play, or those
      that an export of the source would write.
    - ``env``: ``3DBall``, ``GridWorld``, ``Hallway``, ``Tennis`` or ``Crawler2D``; a Gymnasium id; ``module:make``,
      your own code, which runs in this process; or a function that makes a World (exporter/play/worlds.py).
    - ``options``: episodes, seed, margin, and whether actions are drawn; ``partner``: the bundle that plays the other
      side, where there is one.
    - ``names``, ``read``, ``verify``: as for ``compare``.

    What a bundle's own formats earned is kept in its parity.json.
    Raises ExportModelError; a difference is not raised, ``passed`` is False::

        report = export_model.play("exported/3DBall", "3DBall")
        print(report.sentence)
    """
    read = read or ReadOptions()
    return play_policy(
        reference,
        env,
        candidates,
        options=options,
        partner=partner,
        names=names,
        understanding=compile_options(read),
        read=read.for_reader(),
        judging=_judged_by(verify),
    )
