"""Who takes part in a verification: each format of the tested in each runtime that runs it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.consumers.named_files import answered_outputs
from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.converters.formats.registry import FROZEN_GRAPH, WRITTEN
from export_model.converters.formats.source import OriginalRun
from export_model.converters.graph.nodes import Graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.exporter.verify.findings import Finding
from export_model.signatures.batches import batches_of, put_together, rows_of
from export_model.signatures.code import CodeOptions
from export_model.signatures.spec import PolicySignature, SourceMap

if TYPE_CHECKING:
    from export_model.converters.policy.policy import Policy
    from export_model.exporter.verify.reference import Reference
if not TYPE_CHECKING:  # what asks a record for its signature looks the name up
    Policy = Any

#: The runtime that takes longest to start, by far.
_SLOWEST = "tensorflow"
_RUNTIMES = {r.name: r for r in RUNTIMES}

Feeds = Mapping[str, np.ndarray]
#: (format, runtime, error, the output or "*" for all): what did not run goes here.
Failure = Callable[[str, str, RunFailedError, str], None]
#: What is fetched for each of several inputs.
Run = Callable[[Sequence[Feeds], Sequence[str]], list[dict[str, np.ndarray]]]
#: Loads an artefact in a pool: the model, to be unloaded, and how to run that. Of one that ``answered`` before nobody
#: fears that it has no end.
Loading = Callable[[RuntimePool, bool], tuple[LoadedModel, Run]]


class PolicyUnderTest(Struct, frozen=True, kw_only=True):
    """What is verified: the artefacts of one policy, and where its source is; ``policy_under_test`` makes it."""

    name: str
    signature: PolicySignature
    graph: Graph
    #: format → path that a loader is given
    artefacts: Mapping[str, Path]
    sizes: Mapping[str, int]
    #: a .bytes of the policy for the numpy reference (the artefact itself, or one made for this)
    reference: Path
    source: OriginalRun | None = None
    source_map: SourceMap = field(default_factory=SourceMap)
    #: signatures of the SavedModel: key → (inputs, outputs)
    signatures: Mapping[str, tuple[Sequence[str], Sequence[str]]] = field(default_factory=dict)
    #: the profile that it was made for (``--for``), and format → the bundle's own file
    profile: str | None = None
    files: Mapping[str, Path] = field(default_factory=dict)
    #: for how many agents its artefacts are (None: for any number)
    batch: int | None = None
    #: how its source code was written
    code: CodeOptions = CodeOptions()
    #: whether a library that is here runs the source by itself, though verification does not ask it
    runs_elsewhere: bool = False
    #: the policy before its action was baked: the source answers as that, and the judge applies what is stated
    before: Policy | None = None
    #: the source's own samplers begin alike after every start: so may what it is held against
    seeded: bool = False
    #: the kernels run its .bytes too, where that is not their reference
    reread: bool = False


def write_reference(policy: Policy, folder: Path, name: str = "reference") -> Path:
    """Write the policy as the numpy kernels run it; return the file. Raises OSError."""
    from export_model.converters.formats.frozen_graph.writer import frozen_graph

    folder.mkdir(exist_ok=True)
    file = folder / FROZEN_GRAPH.main_of(name)
    frozen_graph(policy).write(file)
    return file


def policy_under_test(
    policy: Policy,
    artefacts: Mapping[str, Path],
    scratch: Path,
    *,
    sizes: Mapping[str, int],
    reference: Path | None = None,
    source: OriginalRun | None = None,
    files: Mapping[str, Path] | None = None,
    profile: str | None = None,
    batch: int | None = None,
    code: CodeOptions | None = None,
    runs_elsewhere: bool = False,
    before: Policy | None = None,
    seeded: bool = False,
    reread: bool = False,
) -> PolicyUnderTest:
    """Return what is verified of a policy and its ``artefacts`` (format → path that a loader is given).

    ``reference`` is what the numpy kernels run; without one it is the artefact that is a frozen graph, else one that is
    written to ``scratch``. ``files`` are the bundle's own, where the artefacts are copies. Raises OSError.
    """
    from export_model.converters.formats.saved_model.writer import signatures_of

    reference = reference or artefacts.get(FROZEN_GRAPH.key) or write_reference(policy, scratch)
    return PolicyUnderTest(
        name=policy.name,
        signature=policy.signature,
        graph=policy.graph,
        artefacts=artefacts,
        sizes=sizes,
        reference=reference,
        source=source,
        source_map=policy.source,
        signatures={k: ([s.name for s in i], [s.name for s in o]) for k, (i, o) in signatures_of(policy).items()},
        profile=profile,
        files=artefacts if files is None else files,
        batch=batch,
        code=code or CodeOptions(),
        runs_elsewhere=runs_elsewhere,
        before=before,
        seeded=seeded,
        reread=reread,
    )


class Participant(Struct, kw_only=True):
    """One format in one runtime: how to run it, what it can answer. ``model`` runs inner tensors too."""

    format: str
    runtime: str
    run: Run
    outputs: Sequence[str]
    model: LoadedModel
    #: what the report calls it, where the format is not enough
    label: str = ""
    #: outputs that it draws by itself, though the reference is fed the noise: held to their shape and distribution
    drawn: frozenset[str] = frozenset()
    #: what the loader was given; None where there is nothing to look into when it fails
    path: Path | None = None
    #: what the model itself is fed, where any tool may have made it: its own names for the policy's inputs
    fed: Callable[[Feeds], Feeds] | None = None
    #: what the model calls the policy's inputs and outputs, where not the same
    called: Mapping[str, str] = field(default_factory=dict)
    #: loads it anew
    again: Loading | None = None

    @property
    def name(self) -> str:
        """What the report calls it."""
        return self.label or self.format


def needed_runtimes(tested: PolicyUnderTest, runtimes: Sequence[str]) -> list[str]:
    """Those of ``runtimes`` that run something of this policy, the reference's first."""
    source = () if tested.source is None else (tested.source.runtime,)
    useful = [
        "numpy",
        *source,
        *(r for kind in tested.artefacts for r in WRITTEN[kind].runtimes if not unfit_reason(r, tested)),
    ]
    return [r for r in dict.fromkeys(useful) if r == "numpy" or r in runtimes]


def participants_of(
    tested: PolicyUnderTest,
    runtimes: Sequence[str],
    pool: RuntimePool,
    reference: Reference,
    failure: Failure,
) -> Iterator[Participant]:
    """The numpy kernels beside an original that ran, then every format in every runtime, loaded one at a time.

    What does not load goes to ``failure`` (format, runtime, error) and takes no part.
    """
    if reference.original is not None:  # else it would be held against itself
        yield reference.participant("reference", reference.asked, path=tested.reference)
    pairs = [(kind, r) for kind in tested.artefacts for r in WRITTEN[kind].runtimes if not unfit_reason(r, tested)]
    # What runs nowhere else is run by the kernels, as are files that verify holds against their source made anew.
    held = [k for k in tested.artefacts if tested.reference not in (tested.artefacts[k], tested.files.get(k))]
    held = [k for k in tested.artefacts if WRITTEN[k].runtimes == ("numpy",) or (tested.reread and k in held)]
    taking_part = [(k, r) for k, r in pairs if (k in held if r == "numpy" else r in runtimes)]
    # The others run while TensorFlow is still being imported; ``in_order`` puts the report right again.
    for kind, runtime in sorted(taking_part, key=lambda pair: pair[1] == _SLOWEST):
        path = tested.artefacts[kind]
        loads = {"": answered_outputs(WRITTEN[kind], tested.signature, tested.code)}
        if WRITTEN[kind].signatures:
            loads = {key: list(names[1]) for key, names in tested.signatures.items()}
        for key, names in loads.items():
            label = kind if key in ("", "serving_default") else f"{kind}:{key}"
            limit = tested.signatures.get(key)
            running = partial(_predicting, names) if WRITTEN[kind].predicts else partial(_limit_inputs, limit)
            if tested.batch is not None and WRITTEN[kind].fixed:
                running = partial(_in_batches, running, tested.batch, tested.signature)
            again = loading(runtime, path, WRITTEN[kind].loader(key), running)
            for model, run in load_model(again, pool, partial(failure, label, runtime)):
                yield Participant(
                    format=label,
                    runtime=runtime,
                    run=run,
                    outputs=names,
                    model=model,
                    path=path,
                    # The numpy kernels draw from the seed of the verification, whatever the artefact.
                    again=None if runtime == "numpy" else again,
                )


def unfit_reason(runtime: str, tested: PolicyUnderTest) -> str | None:
    """Why a runtime can load no file of the policy, whatever the format; None where it can."""
    info = _RUNTIMES[runtime]
    if info.fixed and tested.batch is None:
        return "takes files for a fixed number of agents alone (--batch)"
    for spec in tested.signature.inputs:
        if info.dtypes and spec.dtype not in info.dtypes:
            return f"has no tensors of {spec.dtype}, as the input {spec.name} is"
    return None


def in_order(results: Iterable[Finding], tested: PolicyUnderTest) -> tuple[Finding, ...]:
    """Results as they are reported: by format and runtime, whichever was ready first. The reference's come first."""
    kinds = list(tested.artefacts)

    def place(result: Finding) -> tuple[int, int]:
        kind = result.format.partition(":")[0]
        if kind not in kinds or result.runtime not in WRITTEN[kind].runtimes:
            return (-1, 0)
        return kinds.index(kind), WRITTEN[kind].runtimes.index(result.runtime)

    return tuple(sorted(results, key=place))


def loading(runtime: str, path: Path, options: Mapping[str, Any], running: Callable[[LoadedModel], Run]) -> Loading:
    """What loads an artefact, as often as it is called, and says by ``running`` how it is run."""

    def load(pool: RuntimePool, answered: bool) -> tuple[LoadedModel, Run]:
        model = pool.process(runtime).load(str(path), answered=answered, **options)
        return model, running(model)

    return load


def load_model(
    load: Loading, pool: RuntimePool, failure: Callable[[RunFailedError, str], None]
) -> Iterator[tuple[LoadedModel, Run]]:
    """Yield the one model that ``load`` gives, and unload it then; nothing, but a ``failure``, where it gives none."""
    try:
        model, run = load(pool, False)
    except RunFailedError as error:
        failure(error, "*")
        return
    yield model, run
    model.unload()


def _limit_inputs(signature: tuple[Sequence[str], Sequence[str]] | None, model: LoadedModel) -> Run:
    if signature is None:
        return model.run_all
    names = frozenset(signature[0])
    return lambda inputs, fetch: model.run_all([{n: a for n, a in i.items() if n in names} for i in inputs], fetch)


def _in_batches(
    running: Callable[[LoadedModel], Run], size: int, signature: PolicySignature, model: LoadedModel
) -> Run:
    """A run of any number of agents by a model that takes ``size`` at a time."""
    run = running(model)
    batched = {s.name for s in signature.inputs if s.batched}

    def all_of(inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[dict[str, np.ndarray]]:
        parts = [batches_of(feeds, size, batched) for feeds in inputs]
        answers = iter(run([part for several in parts for part in several], fetch))
        rows = [rows_of(feeds, batched) for feeds in inputs]
        return [put_together([next(answers) for _ in p], n) for p, n in zip(parts, rows, strict=True)]

    return all_of


def _predicting(outputs: Sequence[str], model: LoadedModel) -> Run:
    """The call that people make in TensorFlow.js, ``predict``, wherever all outputs are asked for."""
    return lambda inputs, fetch: (
        model.predict_all(inputs, outputs) if list(fetch) == list(outputs) else model.run_all(inputs, fetch)
    )
