"""Two files of anyone: a file beside itself, a checkpoint beside its own trainer's ONNX, and pairs that differ."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from msgspec.structs import replace
from onnx import numpy_helper

from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.barracuda.writer import encode
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare import comparison
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from tests.commands import export_model
from tests.comparing import compare_artefacts
from tests.reports.validation import check_parity
from tests.torch_checkpoint import test_state_dicts

ROOT = Path(__file__).resolve().parents[2] / "fixtures"
TORCH = ROOT / "torch_checkpoint"
#: Of these the trainer's own ONNX lost the output of the memory (ML-Agents 0.20 to 0.22).
LOST_MEMORY = {"ppo_0_21_discrete_lstm", "ppo_0_22_lstm"}
PAIRS = sorted(p.stem for p in TORCH.glob("*.pt") if p.with_suffix(".onnx").exists())
ALONE = [
    "torch_checkpoint/ppo_1_1_hybrid_lstm.pt",
    "torchscript/isaac_gru_script.pt",
    "torchscript/legged_lstm_trace.pt",
    "sb3_zip/ppo_box.zip",
    "robots/sbx_ppo_discrete.zip",
    "sb3/sb3_stochastic.onnx",
]


def compared(reference: Path, candidate: Path, pool: RuntimePool, **names: str) -> ParityReport:
    return compare_artefacts(reference, candidate, names=names, runtimes="onnxruntime", pool=pool)


@pytest.mark.parametrize("name", ALONE)
def test_a_file_agrees_with_itself(name: str, pool: RuntimePool) -> None:
    report = compared(ROOT / name, ROOT / name, pool)
    assert report.passed is True
    assert any(c.output.endswith(("action", "actions")) for c in report.comparisons)


@pytest.mark.parametrize(
    ("name", "kinds"),
    [(name, ("pt", "onnx")) for name in PAIRS]
    + [(name, ("onnx", "pt")) for name in ("ppo_1_1_hybrid_lstm", "sac_1_1")],
)
def test_a_checkpoint_agrees_with_its_trainers_own_onnx(name: str, kinds: tuple[str, str], pool: RuntimePool) -> None:
    reference, candidate = (TORCH / f"{name}.{kind}" for kind in kinds)
    report = compared(reference, candidate, pool)
    if kinds[1] == "onnx" and name in LOST_MEMORY:
        assert [f.output for f in report.failures] == ["recurrent_out"]
        return
    assert report.passed is True, report.failures
    assert not report.self_consistent, "the ONNX ran in its own runtime"


def changed(name: str, target: Path, edit: Callable[[np.ndarray], np.ndarray]) -> Path:
    model = onnx.load(TORCH / f"{name}.onnx")
    weight = next(t for t in model.graph.initializer if "action_model" in t.name and len(t.dims) == 2)
    weight.CopyFrom(numpy_helper.from_array(edit(numpy_helper.to_array(weight)), weight.name))
    onnx.save(model, target)
    return target


@pytest.mark.parametrize("name", ["ppo_1_1", "ppo_0_24_hybrid", "ppo_1_1_discrete", "sac_1_1"])
def test_another_policy_fails(name: str, tmp_path: Path, pool: RuntimePool) -> None:
    wrong = changed(name, tmp_path / "theirs.onnx", lambda w: np.ascontiguousarray(w[:, ::-1]))
    assert compared(TORCH / f"{name}.pt", wrong, pool).passed is False


def test_a_fixed_batch_is_fed_in_its_size(tmp_path: Path, pool: RuntimePool) -> None:
    model = onnx.load(TORCH / "ppo_1_1.onnx")
    for value in model.graph.input:
        value.type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save(model, tmp_path / "one.onnx")
    report = compared(TORCH / "ppo_1_1.pt", tmp_path / "one.onnx", pool)
    assert report.passed is True
    assert "onnx takes 1 row at a time, and was compared so" in report.notes


def test_a_policy_that_draws_is_compared_without_chance_with_one_of_another_maker_that_does_not(
    tmp_path: Path, pool: RuntimePool
) -> None:
    model = onnx.load(TORCH / "ppo_1_1.onnx")
    renamed = onnx.ValueInfoProto()
    renamed.CopyFrom(next(v for v in model.graph.output if v.name == "deterministic_continuous_actions"))
    renamed.name = "actions"
    del model.graph.output[:]
    model.graph.output.append(renamed)
    for node in model.graph.node:
        node.output[:] = ["actions" if n == "deterministic_continuous_actions" else n for n in node.output]
        node.input[:] = ["actions" if n == "deterministic_continuous_actions" else n for n in node.input]
    onnx.save(model, tmp_path / "plain.onnx")
    report = compared(TORCH / "ppo_1_1.pt", tmp_path / "plain.onnx", pool)
    assert report.passed is True, report.failures
    assert any("the reference draws action and the candidate does not" in note for note in report.notes)
    assert {c.output for c in report.comparisons} == {"deterministic_action"}


def test_what_no_runtime_loads_is_said_to_have_run_as_what_was_written_of_it(tmp_path: Path, pool: RuntimePool) -> None:
    own = shutil.copy(TORCH / "ppo_1_1.pt", tmp_path / "own.pt")
    report = compared(TORCH / "ppo_1_1.pt", Path(own), pool)
    assert report.self_consistent
    assert "torch_checkpoint was run as export-model's ONNX model of it" in report.notes


def test_a_barracuda_file_of_another_maker_agrees_with_itself(tmp_path: Path, pool: RuntimePool) -> None:
    """It embeds no contract."""
    (result,) = export([ROOT / "continuous.bytes"], ExportOptions(tmp_path, targets=("nn",), verify="none"))
    model = parse((result.folder / "continuous.nn").read_bytes())
    other = tmp_path / "theirs.nn"
    other.write_bytes(encode(replace(model, trailer=None)))
    report = compared(other, other, pool)
    assert report.passed is True, report.failures


def with_seed(model: onnx.ModelProto, seed: int | float) -> None:
    sampler = next(n for n in model.graph.node if n.op_type == "RandomNormalLike")
    kept = [a for a in sampler.attribute if a.name != "seed"]
    del sampler.attribute[:]
    sampler.attribute.extend([*kept, onnx.helper.make_attribute("seed", seed)])


@pytest.mark.parametrize("seed", [7, 7.0])
def test_a_file_with_a_seed_agrees_with_itself(seed: float, tmp_path: Path, pool: RuntimePool) -> None:
    """tf2onnx 1.5.5 wrote seeds as integers, which onnxruntime refuses: the copy that is run has them as floats."""
    model = onnx.load(TORCH / "ppo_1_1.onnx")
    with_seed(model, seed)
    onnx.save(model, tmp_path / "seed.onnx")
    report = compared(tmp_path / "seed.onnx", tmp_path / "seed.onnx", pool)
    assert report.passed is True, report.failures
    assert any("a sampler has a fixed seed, as the reference's has" in note for note in report.notes)
    report = compared(TORCH / "ppo_1_1.onnx", tmp_path / "seed.onnx", pool)
    assert report.passed is False, "the reference draws anew after every start"


@pytest.mark.parametrize("name", sorted(LOST_MEMORY))
def test_a_file_that_lost_its_memory_agrees_with_itself(name: str, pool: RuntimePool) -> None:
    assert compared(TORCH / f"{name}.onnx", TORCH / f"{name}.onnx", pool).passed is True


@pytest.mark.parametrize("right", [True, False])
def test_what_json_says_of_a_pair_fits_the_schema(right: bool, tmp_path: Path) -> None:
    wrong = changed("ppo_1_1", tmp_path / "theirs.onnx", lambda w: np.ascontiguousarray(w[:, ::-1]))
    candidate = TORCH / "ppo_1_1.onnx" if right else wrong
    ran = export_model("compare", TORCH / "ppo_1_1.pt", candidate, "--verify", "onnxruntime", "--json")
    assert ran.status == (not right)
    printed = json.loads(ran.out)
    assert list(printed) == ["reports"]
    (report,) = printed["reports"]
    check_parity(json.dumps(report))
    assert report["verdict"] == ("passed" if right else "failed")


def stripped(name: str, lost: str, folder: Path) -> tuple[Path, Path]:
    """A checkpoint, and an ONNX of it that gives all but one output and says nothing of its maker."""
    checkpoint = test_state_dicts.saved(folder, name)
    read = test_state_dicts.options(name)
    (result,) = export([checkpoint], ExportOptions(folder / "made", ("onnx",), verify="none", read=read))
    model = onnx.load(result.folder / f"{result.policy.name}.onnx")
    kept = [o for o in model.graph.output if o.name not in (lost, "deterministic_action")]
    del model.graph.output[:], model.metadata_props[:]
    model.graph.output.extend(kept)
    onnx.save(model, folder / "theirs.onnx")
    return checkpoint, folder / "theirs.onnx"


@pytest.mark.parametrize(
    ("name", "lost", "failing"),
    [("rsl_5_5", "action_std", []), ("rsl_5_5_gru", "recurrent_out", ["recurrent_out"])],
)
def test_a_deviation_may_be_left_out_and_a_memory_not(
    name: str, lost: str, failing: list[str], tmp_path: Path, pool: RuntimePool
) -> None:
    """That both call an action "action" does not tell that they are of one maker."""
    checkpoint, theirs = stripped(name, lost, tmp_path)
    options = comparison.CompareOptions(
        judging=VerifyOptions(runtimes="onnxruntime"), read=test_state_dicts.options(name)
    )
    report = comparison.compare_artefacts(checkpoint, theirs, options, pool=pool)
    assert [f.output for f in report.failures] == failing
