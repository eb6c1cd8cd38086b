"""Faults of behaviour, planted: each is found in the replay, which names where it begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import onnx
import pytest

from export_model.exporter.compare import comparison
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.verify.options import VerifyOptions
from tests.play.conftest import FEW, Play
from tests.play.faults import IN_FILES, IN_PROGRAMS, Answer, Array, Fault, ProgramFault

ONE = VerifyOptions(runtimes="onnxruntime")


@pytest.mark.parametrize("fault", IN_FILES, ids=lambda f: f.name)
def test_the_replay_names_the_tensor(fault: Fault, bundles: Path, tmp_path: Path, play: Play) -> None:
    model = onnx.load(bundles / fault.policy / f"{fault.policy}.onnx")
    fault.edit(model)
    onnx.save(model, tmp_path / "faulty.onnx")
    report = play(bundles / fault.policy, fault.policy, tmp_path / "faulty.onnx", options=PlayOptions(FEW), judging=ONE)
    assert report.passed is False
    found = [c.bisection for c in report.replay.failures if c.bisection is not None]
    assert found and {b.tensor for b in found} <= {*fault.first}


@pytest.mark.parametrize("fault", IN_PROGRAMS, ids=lambda f: f.name)
def test_the_replay_names_the_output(
    fault: ProgramFault, bundles: Path, play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    renamed = comparison._run_renamed

    def faulty(*given: Any) -> Any:
        run = renamed(*given)
        wrapped: dict[tuple[str, ...], Answer] = {}

        def answered(inputs: Sequence[Mapping[str, Array]], fetch: Sequence[str]) -> list[dict[str, Array]]:
            names = tuple(fetch)
            if names not in wrapped:
                wrapped[names] = fault.wrap(lambda feeds: run([feeds], names)[0])
            return [wrapped[names](feeds) for feeds in inputs]

        return answered

    monkeypatch.setattr(comparison, "_run_renamed", faulty)
    folder = bundles / fault.policy
    report = play(folder, fault.policy, folder / f"{fault.policy}.onnx", options=PlayOptions(FEW), judging=ONE)
    assert report.passed is False
    assert {c.output for c in report.replay.failures} & {*fault.outputs}
