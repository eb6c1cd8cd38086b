"""Verification of small policies with no process: the kernels of the numpy child, and a runtime that goes wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.registry import FROZEN_GRAPH
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.numpy import child
from export_model.converters.runtimes.registry import RuntimeInfo
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Feeds, Participant, policy_under_test
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.verification import CHECKS, Check, verify
from export_model.signatures.errors import ExportModelError
from tests.handmade import graph_bytes

Arrays = dict[str, npt.NDArray[Any]]
#: What a runtime is fed and what it answers → what it says instead.
Spoil = Callable[[Feeds, Arrays], Arrays]
KNOWN = tuple(RuntimeInfo(name, True, "1.0", "") for name in ("numpy", "onnxruntime"))


class Model:
    """A model of the numpy child, in this process."""

    def __init__(self, path: str, **options: Any) -> None:
        self._model = child._load({"path": path, **options})

    def run(self, feeds: Feeds, fetch: Sequence[str], **request: Any) -> Arrays:
        try:
            return dict(self._model.run(dict(feeds), list(fetch), request))
        except ExportModelError as error:
            raise RunFailedError(str(error)) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def run_all(
        self, inputs: Sequence[Feeds], fetch: Sequence[str], requests: Sequence[Mapping[str, Any]] = ()
    ) -> list[Arrays]:
        more = requests or [{}] * len(inputs)
        return [self.run(feeds, fetch, **request) for feeds, request in zip(inputs, more, strict=True)]

    def unload(self) -> None:
        pass


class Pool:
    """Takes the part of a RuntimePool."""

    def start(self, names: object) -> None:
        pass

    def process(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(load=Model)

    def versions(self) -> dict[str, str]:
        return {"numpy": "1", "onnxruntime": "1"}


def compiled(nodes: Sequence[Any], options: CompileOptions | None = None) -> Policy:
    """The policy of a frozen graph made by hand."""
    (policy,) = compile_graph(read_graph(graph_bytes(nodes)), "policy", options)
    return policy


def judge(
    policy: Policy,
    folder: Path,
    spoil: Spoil = lambda feeds, answers: answers,
    *,
    checks: Sequence[Check] = CHECKS,
    options: VerifyOptions | None = None,
    inputs: Any = None,
    runtime: str = "onnxruntime",
) -> ParityReport:
    """The report on a runtime that says ``spoil`` of what the kernels answer."""
    tested = policy_under_test(policy, {}, folder, sizes={})

    def participants(numpy: Any, failed: object) -> Iterator[Participant]:
        def run(given: Sequence[Feeds], fetch: Sequence[str]) -> list[Arrays]:
            return [spoil(feeds, numpy.run(feeds, fetch)) for feeds in given]

        outputs = [s.name for s in policy.signature.outputs]
        yield Participant(format="onnx", runtime=runtime, run=run, outputs=outputs, model=numpy)

    session = Session(("numpy", runtime), KNOWN, Pool(), options or VerifyOptions())  # type: ignore[arg-type]
    return verify(tested, session, participants, inputs, checks)


class Lying(Model):
    """A model that says ``spoil`` of what the kernels answer, of inner tensors too."""

    def __init__(self, path: str, spoil: Spoil) -> None:
        super().__init__(path)
        self._spoil = spoil

    def run(self, feeds: Feeds, fetch: Sequence[str], **request: Any) -> Arrays:
        return self._spoil(feeds, super().run(feeds, fetch, **request))


def judge_file(
    policy: Policy,
    folder: Path,
    spoil: Spoil = lambda feeds, answers: answers,
    *,
    again: Spoil | None = None,
    checks: Sequence[Check] = CHECKS,
    options: VerifyOptions | None = None,
    seeded: bool = False,
    file: Path | None = None,
    **participant: Any,
) -> ParityReport:
    """As ``judge``, of a frozen graph that can be looked into: its samplers are cut, its tensors fetched.

    ``again`` is what a runtime says that is started anew, ``file`` a candidate in place of the policy's own.
    """
    tested = policy_under_test(policy, {}, folder, sizes={}, seeded=seeded)

    def load(pool: object, answered: bool) -> tuple[Any, Any]:
        model = Lying(str(tested.reference), again or spoil)
        return model, model.run_all

    def participants(numpy: Any, failed: object) -> Iterator[Participant]:
        model = Lying(str(file or tested.reference), spoil)
        fed = participant.get("fed") or (lambda feeds: feeds)

        def run(inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[Arrays]:
            return model.run_all([fed(feeds) for feeds in inputs], fetch)

        yield Participant(
            format=FROZEN_GRAPH.key,
            runtime="onnxruntime",
            run=run,
            outputs=[s.name for s in policy.signature.outputs],
            model=model,  # type: ignore[arg-type]
            path=file or tested.reference,
            again=None if again is None else load,  # type: ignore[arg-type]
            **participant,
        )

    session = Session(("numpy", "onnxruntime"), KNOWN, Pool(), options or VerifyOptions())  # type: ignore[arg-type]
    return verify(tested, session, participants, None, checks)


def wrong(report: ParityReport) -> set[tuple[str, str]]:
    """(kind, output) of what failed."""
    return {(f.kind, f.output) for f in report.failures}


def spoiling(output: str, how: Callable[[Feeds, npt.NDArray[Any]], npt.NDArray[Any]]) -> Spoil:
    """One output is what ``how`` makes of the inputs and of itself."""

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: np.asarray(how(feeds, a)) if n == output else a for n, a in answers.items()}

    return spoil
