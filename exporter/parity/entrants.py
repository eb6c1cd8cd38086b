"""Who takes part in a verification: each format of the subject in each runtime that runs it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from converters.runner.process import LoadedModel, RunFailedError
from exporter.parity.pool import RUNTIMES_OF, RuntimePool
from exporter.parity.subject import Subject

Feeds = Mapping[str, np.ndarray]
Run = Callable[[Feeds, Sequence[str]], dict[str, np.ndarray]]


@dataclass
class Entrant:
    """One format in one runtime: how to run it, what it can answer. ``model`` runs inner tensors too."""

    format: str
    runtime: str
    run: Run
    outputs: Sequence[str]
    model: LoadedModel


def entrants(
    subject: Subject,
    runtimes: Sequence[str],
    pool: RuntimePool,
    reference: LoadedModel,
    failure: Callable[[str, str, RunFailedError], None],
) -> Iterator[Entrant]:
    """The numpy reference, then every format in every runtime, loaded one at a time.

    What does not load goes to ``failure`` (format, runtime, error) and takes no part.
    """
    outputs = [s.name for s in subject.signature.outputs]
    yield Entrant("reference", "numpy", reference.run, outputs, reference)
    for kind, path in subject.artefacts.items():
        for runtime in RUNTIMES_OF[kind]:
            if runtime not in runtimes or runtime == "numpy":
                continue
            loads = {"": list(outputs)}
            if kind == "saved_model":
                loads = {key: list(names[1]) for key, names in subject.signatures.items()}
            for key, names in loads.items():
                label = kind if key in ("", "serving_default") else f"{kind}:{key}"
                try:
                    shape = {"kind": "saved_model", "signature": key} if kind == "saved_model" else {"kind": "graph"}
                    model = pool.process(runtime).load(str(path), **shape)
                except RunFailedError as error:
                    failure(label, runtime, error)
                    continue
                run = _limited(model.run, subject.signatures.get(key))
                if kind == "tfjs":
                    run = _predicting(model, names)
                yield Entrant(label, runtime, run, names, model)
                unload(model)


def unload(model: LoadedModel) -> None:
    """Free a model; a runtime that has died has freed it already."""
    with contextlib.suppress(RunFailedError):
        model.unload()


def _limited(run: Run, signature: tuple[Sequence[str], Sequence[str]] | None) -> Run:
    """Feed only what a signature takes."""
    if signature is None:
        return run
    inputs = frozenset(signature[0])
    return lambda feeds, fetch: run({n: a for n, a in feeds.items() if n in inputs}, fetch)


def _predicting(model: LoadedModel, outputs: Sequence[str]) -> Run:
    """The call that people make in TensorFlow.js, ``predict``, wherever all outputs are asked for."""
    return lambda feeds, fetch: (
        model.predict(feeds, outputs) if list(fetch) == list(outputs) else model.run(feeds, fetch)
    )
