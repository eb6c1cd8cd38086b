"""A policy out of a bundle or a source, loaded into this process, ready to decide."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from export_model.exporter.acting.one_memory import with_one_memory
from export_model.exporter.acting.policy import LoadedPolicy
from export_model.signatures.batches import Run, in_batches
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import BundleError, RuntimeUnavailableError, UsageError, naming
from export_model.signatures.fields import printable

if TYPE_CHECKING:
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.bundle.bundle import Declared
    from export_model.converters.formats.format import Format
    from export_model.converters.formats.source import ReadOptions

Array = np.ndarray
#: What runs a policy in this process, the preferred first.
RUNTIMES = ("onnxruntime", "numpy")


def load_policy(
    source: Path | str,
    runtime: str | None = None,
    seed: int = 0,
    compiling: CompileOptions | None = None,
    read: ReadOptions | None = None,
) -> LoadedPolicy:
    """Load the policy of a bundle or a source, read as the options say. A bundle's file is checked by its hash.

    Raises BundleError, RuntimeUnavailableError, UsageError, and for a source what an export would raise.
    """
    from export_model.converters.compiler.options import CompileOptions
    from export_model.converters.formats.source import ReadOptions

    path, compiling = Path(source), compiling or CompileOptions()
    if runtime not in (None, *RUNTIMES):
        raise UsageError(f"runtime={runtime!r}: must be one of {', '.join(RUNTIMES)}")
    if path.is_dir() and (path / POLICY).exists():
        if compiling.brain is not None:
            raise UsageError(f"brain={compiling.brain!r}", why="a bundle holds one policy", fix="leave brain out")
        if compiling != CompileOptions() or read not in (None, ReadOptions()):
            raise UsageError("a bundle is loaded as it is", why="read= is for sources", fix="leave read= out")
        return _of_bundle(path, runtime, seed)
    return _of_source(path, runtime, seed, compiling, read)


def _taken_by(runtime: str) -> Format:
    """The format that a runtime runs before all others."""
    from export_model.converters.formats.registry import WRITTEN

    return next(f for f in WRITTEN.values() if f.runtimes[:1] == (runtime,))


def _of_bundle(folder: Path, runtime: str | None, seed: int) -> LoadedPolicy:
    from export_model.converters.formats.bundle.bundle import Bundle

    found = Bundle.open(folder)
    named = {r: found.path(_taken_by(r)) for r in RUNTIMES if found.has(_taken_by(r))}
    files = {r: path for r, path in named.items() if path.is_file()}
    here = [r for r in RUNTIMES if r in files and (r == "numpy" or importlib.util.find_spec(r) is not None)]
    if runtime is not None and runtime not in here:
        if runtime not in files:
            wanted = found.path(_taken_by(runtime)).name
            raise BundleError(f"has no {wanted}", where=str(folder), fix="export the policy with it again")
        raise RuntimeUnavailableError("onnxruntime is not installed", fix="pip install 'export-model[onnxruntime]'")
    if not here:
        raise BundleError(
            "has nothing that can be run here",
            where=str(folder),
            why="onnxruntime runs its .onnx, numpy its .bytes",
            fix="export the policy with --to bytes,onnx",
        )
    chosen = runtime or here[0]
    found.verify_hashes(_taken_by(chosen))
    kept = found.contract.source.noise_kept and bool(found.contract.source.noise)
    signature = found.signature
    with naming(files[chosen]):
        model = _READS[chosen](files[chosen], [s.name for s in (*signature.inputs, *signature.outputs)])
        run, declared = _RUNS[chosen](model)
    found.check_fits(files[chosen], declared)
    run = in_batches(run, found.contract.tool.get("batch") if chosen == "onnxruntime" else None, signature)
    signature, run = with_one_memory(signature, run)
    return LoadedPolicy(found.name, signature, run, chosen, seed, draws_itself=kept)


def _of_source(
    path: Path, runtime: str | None, seed: int, compiling: CompileOptions, read: ReadOptions | None
) -> LoadedPolicy:
    """A source's only policy, compiled and written in memory."""
    from export_model.converters.formats.format import WriteOptions
    from export_model.exporter.export.sources import read_source

    policies = read_source(path, read).policies(compiling)
    if len(policies) != 1:
        raise UsageError(
            f"{path} holds {len(policies)} policies",
            fix=f"choose one: brain=…, or export it and load a bundle ({', '.join(p.name for p in policies)})",
        )
    (policy,) = policies
    chosen = runtime or next(r for r in RUNTIMES if r == "numpy" or importlib.util.find_spec(r) is not None)
    if importlib.util.find_spec(chosen) is None:
        raise RuntimeUnavailableError("onnxruntime is not installed", fix="pip install 'export-model[onnxruntime]'")
    with naming(path):
        artifact = _taken_by(chosen).artifact(policy, WriteOptions("{}"))
        run, _ = _RUNS[chosen](artifact.files[artifact.main].to_bytes())
    kept = policy.source.noise_kept and bool(policy.source.noise)
    return LoadedPolicy(policy.name, policy.signature, run, chosen, seed, draws_itself=kept)


def _in_onnxruntime(model: bytes) -> tuple[Run, Declared]:
    import onnxruntime  # noqa: TID251  the caller asked for a policy that acts
    from onnxruntime.capi import onnxruntime_pybind11_state as state  # noqa: TID251

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # a policy is small: threads cost more than they bring
    options.log_severity_level = 4  # errors come as exceptions; onnxruntime would print them as the file has it, too
    known = (kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception))
    faults: tuple[type[Exception], ...] = (*known, RuntimeError)
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except faults as error:
        raise _fault("onnxruntime does not load it", error) from error

    def run(feeds: Mapping[str, Array], fetch: Sequence[str]) -> dict[str, Array]:
        try:
            return dict(zip(fetch, session.run(list(fetch), dict(feeds)), strict=True))
        except faults as error:
            raise _fault("onnxruntime failed while it ran the policy", error) from error

    return run, {t.name: (None, t.shape) for t in (*session.get_inputs(), *session.get_outputs())}


def _fault(what: str, error: Exception) -> BundleError:
    return BundleError(what, why=printable(str(error))[:600], fix="export the policy again")


def _in_numpy(model: bytes) -> tuple[Run, Declared]:
    from export_model.converters.formats.bundle.bundle import declared_by
    from export_model.converters.formats.embed import runnable
    from export_model.converters.formats.frozen_graph.reader import read_graph
    from export_model.converters.graph.run import run_graph

    graph = runnable(read_graph(model))
    return lambda feeds, fetch: run_graph(graph, feeds, fetch), declared_by(graph)


def _for_onnxruntime(path: Path, names: Sequence[str]) -> bytes:
    from export_model.converters.formats.onnx.vetted import flat

    return flat(path, names)


def _for_numpy(path: Path, names: Sequence[str]) -> bytes:
    from export_model.converters.files.folders import scratch_folder

    vetted = _taken_by("numpy").vetted
    assert vetted is not None
    with scratch_folder() as folder:
        return vetted(path, names, folder).read_bytes()


#: What a runtime is given of a bundle's file: (the file, the names of its inputs and outputs) → a model.
_READS: Mapping[str, Callable[[Path, Sequence[str]], bytes]] = {
    "onnxruntime": _for_onnxruntime,
    "numpy": _for_numpy,
}
_RUNS: Mapping[str, Callable[[bytes], tuple[Run, Declared]]] = {"onnxruntime": _in_onnxruntime, "numpy": _in_numpy}
