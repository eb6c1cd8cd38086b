"""A ``.nn`` under the names of its contract, in a bundle, and verified there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.consumers.mlagents.own_names import NnPolicy, answered_outputs
from export_model.converters.consumers.named_files import artifact_of
from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.barracuda.writer import contract_of, encode
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.tolerances import Tolerance, tolerance_for
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.errors import BundleError, DamagedFileError
from export_model.signatures.roles import Role
from tests.barracuda.conftest import SHARED, params
from tests.barracuda.nn_running import fed, some
from tests.barracuda.reference import evaluate
from tests.barracuda.test_writer import FIXTURES, policies


def test_it_is_written_on_request_only() -> None:
    assert "nn" in WRITTEN
    assert "nn" not in DEFAULTS


@pytest.mark.parametrize("path", FIXTURES, ids=lambda p: p.stem)
@pytest.mark.parametrize("options", [{}, {"names": "source"}, {"deterministic": True}, {"noise": "zero"}], ids=str)
def test_it_answers_every_output_but_a_drawn_class(path: Path, options: dict[str, Any]) -> None:
    for policy in policies(path, **options):
        signature = policy.signature
        contract = WriteOptions(json.dumps(signature.to_dict()))
        (data,) = artifact_of(WRITTEN["nn"], policy, contract).files.values()
        nn = NnPolicy(data.to_bytes())
        assert nn.signature.to_dict() == signature.to_dict()
        names = answered_outputs(signature)
        assert names == [s.name for s in signature.outputs if s.role is not Role.SAMPLED]
        for rows in (1, 3):
            feeds = some(policy, rows)
            expected = run_graph(policy.graph, feeds, names)
            for name, value in nn.run(feeds, names).items():
                assert value.dtype == expected[name].dtype, name
                bound = tolerance_for(signature, name, Tolerance())
                np.testing.assert_allclose(value, expected[name], atol=max(bound.atol, 1e-3), rtol=1e-3, err_msg=name)


@pytest.mark.parametrize("role", [Role.LOG_PROB, Role.STD, Role.LOG_STD, Role.OTHER, Role.Q_VALUES])
def test_what_a_nn_has_no_name_for_is_not_answered_by_its_action(role: Role) -> None:
    """Stable-Baselines3's log-probability was: its file was called wrong, and set aside."""
    (policy,) = policies(next(p for p in FIXTURES if p.stem == "continuous"))
    signature = policy.signature
    extra = replace(signature.output("value_estimate"), name="extra", role=role)
    signature = replace(signature, outputs=(*signature.outputs, extra))
    more = replace(policy, signature=signature, fetches={**policy.fetches, "extra": policy.fetches["value_estimate"]})
    (data,) = artifact_of(WRITTEN["nn"], more, WriteOptions(json.dumps(signature.to_dict()))).files.values()
    names = answered_outputs(signature)
    assert names == [s.name for s in policy.signature.outputs]
    feeds = some(policy, 3)
    assert NnPolicy(data.to_bytes()).run(feeds, names).keys() == run_graph(policy.graph, feeds, names).keys()


def test_a_file_without_a_contract_says_so() -> None:
    policy = policies(FIXTURES[0])[0]
    (data,) = artifact_of(WRITTEN["nn"], policy, WriteOptions("{}")).files.values()
    model = parse(data.to_bytes())
    for other in (model, replace(model, trailer=None)):
        with pytest.raises(DamagedFileError, match="no contract"):
            contract_of(other)


@pytest.mark.parametrize("path", FIXTURES, ids=lambda p: p.stem)
def test_a_bundle_of_a_nn_alone_is_written_and_verified(path: Path, tmp_path: Path, pool: RuntimePool) -> None:
    for result in export([path], ExportOptions(tmp_path, ["nn"], verify="numpy"), pool=pool):
        assert result.report is not None
        assert result.report.passed is None, "no runtime computes it by itself"
        report = verify_folder(result.folder, runtimes="numpy")
        assert report.passed is None
        assert not [c for c in report.comparisons if not c.passed], failure_lines(report)
        assert {(c.format, c.runtime) for c in report.comparisons} == {("nn", "numpy")}
        assert any("only Unity runs a .nn" in note for note in report.notes)


def test_a_nn_whose_numbers_or_contract_were_changed_is_found(tmp_path: Path, pool: RuntimePool) -> None:
    (path,) = (p for p in FIXTURES if p.stem == "continuous")
    (result,) = export([path], ExportOptions(tmp_path, ["bytes", "nn"], verify="numpy"), pool=pool)
    file = result.folder / "continuous.nn"
    model = parse(file.read_bytes())
    weights = model.weights.copy()
    weights[np.abs(weights).argmax()] += 1
    content = json.loads((result.folder / "policy.json").read_text())

    def put(data: bytes) -> None:
        from export_model.signatures.digest import sha256_hex

        file.write_bytes(data)
        content["files"]["continuous.nn"] = {"sha256": sha256_hex(data), "bytes": len(data)}
        (result.folder / "policy.json").write_text(json.dumps(content))

    put(encode(replace(model, weights=weights)))
    report = verify_folder(result.folder, runtimes="numpy", allow_unverified=True)
    assert report.passed is False
    assert {c.format for c in report.comparisons if not c.passed} == {"nn"}
    assert model.trailer is not None
    changed = model.trailer.metadata[0][1].replace("continuous", "discrete")
    put(encode(replace(model, trailer=replace(model.trailer, metadata=((EMBEDDED, changed),)))))
    with pytest.raises(BundleError, match="has been changed"):
        verify_folder(result.folder, runtimes="numpy")


FORMS = ("bytes", "saved_model", "tfjs", "onnx", "nn")


@pytest.mark.parametrize("path", FIXTURES, ids=lambda p: p.stem)
@pytest.mark.parametrize("form", FORMS)
def test_a_nn_taken_to_another_format_and_back_acts_the_same(path: Path, form: str, tmp_path: Path) -> None:
    for number, first in enumerate(export([path], ExportOptions(tmp_path / "a", ["nn"], verify="none"))):
        place, out = first.folder / f"{first.policy.name}.nn", tmp_path / f"{number}"
        (between,) = export([place], ExportOptions(out / "b", [form], verify="none"))
        source = between.folder / WRITTEN[form].main_of(between.policy.name)
        (last,) = export([source], ExportOptions(out / "c", ["nn"], verify="none"))
        begun, ended = parse(place.read_bytes()), parse((last.folder / f"{last.policy.name}.nn").read_bytes())
        assert {i.name: i.shape for i in begun.inputs} == {i.name: i.shape for i in ended.inputs}
        assert [(m.input, m.output, m.shape) for m in begun.memories] == [
            (m.input, m.output, m.shape) for m in ended.memories
        ]
        constants = ("version_number", "memory_size", "is_continuous_control", "action_output_shape")
        assert [begun.number(c) for c in constants] == [ended.number(c) for c in constants]
        feeds = fed(first.policy, begun, some(first.policy, 3))
        before, after = evaluate(begun, feeds), evaluate(ended, feeds)
        for name in (*begun.outputs, *(m.output for m in begun.memories)):
            np.testing.assert_allclose(after[name], before[name], atol=2e-5, rtol=2e-5, err_msg=name)
        signature = between.policy.signature
        assert signature.family == first.policy.signature.family
        assert signature.algorithm == first.policy.signature.algorithm
        assert not any("Unity wrote" in note for note in signature.notes)
        memory = first.policy.signature.memory
        assert memory is None or (signature.memory is not None and signature.memory.layout == memory.layout)


GENUINE = sorted(SHARED.glob("genuine/*/Brain*.nn")) + sorted(SHARED.glob("corpus/onnx/*.onnx"))


@pytest.mark.corpus
@pytest.mark.slow
@pytest.mark.parametrize("path", params(GENUINE, lambda p: f"{p.parent.name}-{p.stem}"[-80:]))
def test_a_nn_agrees_in_verification(path: Path, tmp_path: Path, pool: RuntimePool, shared: Path) -> None:
    if any(word in str(path) for word in ("tf115-ppo", "CustomResidual", "Dodge-18499955")):
        pytest.skip("it is damaged, or has observations of variable length")
    for noise in ("lift", "keep"):
        options = ExportOptions(tmp_path / noise, ["nn"], verify="numpy", compile=CompileOptions(noise=noise))
        (result,) = export([path], options, pool=pool)
        assert result.report is not None
        failed = [c for c in result.report.comparisons if not c.passed and c.format != "reference"]
        assert not failed, "\n".join(failure_lines(result.report))
        if not result.policy.signature.noise:
            break  # there is none to keep
