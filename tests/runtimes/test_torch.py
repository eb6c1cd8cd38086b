"""PyTorch as a judge of checkpoints, on request (``pip install 'export-model[torch]'``)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool, chosen_runtimes
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.original import Original
from export_model.signatures.sampling import draw_cases
from fixtures import state_dicts, torch_checkpoint
from tests.commands import export_model
from tests.stable_baselines3 import saved_models
from tests.torch_checkpoint import test_state_dicts
from tests.torchscript import test_modules

ROOT = Path(__file__).resolve().parents[2] / "fixtures"
DICTS = sorted(p.stem for p in state_dicts.FOLDER.glob("*.npz"))
ZIPS = sorted({p.stem for p in (ROOT / "sb3_zip").iterdir() if p.suffix in (".zip", ".json")})
#: Not those whose numbers jump at ties (topk), or grow to 1e26 and NaN at far inputs.
SCRIPTS = sorted(p.stem for p in (ROOT / "torchscript").glob("*.pt") if p.stem[:6] not in ("chosen", "shrunk"))
MLAGENTS = sorted(p.stem for p in (ROOT / "torch_checkpoint").glob("*.pt"))
#: Policies whose networks are not built of PyTorch's layers: images, gSDE, masks, bits, other observations, older ones.
UNBUILT = {
    *("clean_dqn_atari", "clean_ppo_atari_lstm"),
    *(n for n in ZIPS if n.startswith("ars_")),
    *("crossq_box", "crossq_sde", "dqn_eye", "maskable", "maskable_bits", "ppo_bits", "ppo_eye"),
    *("ppo_mixed", "ppo_branches", "ppo_sde", "ppo_state", "sac_sde"),
    *(n for n in MLAGENTS if int(n.split("_")[2]) < 26 and n.split("_")[1] == "0"),
}

pytestmark = pytest.mark.xdist_group("torch")


@pytest.fixture(scope="module")
def here(processes: RuntimePool) -> RuntimePool:
    (info,) = (i for i in available_runtimes() if i.name == "torch")
    if not info.installed:
        pytest.skip(f"torch is not installed: {info.how}")
    return processes


def test_it_is_asked_only_by_its_name() -> None:
    assert "torch" not in chosen_runtimes("auto", [])[0]


def cases() -> Iterator[str]:
    yield from (f"dict {n}" for n in DICTS)
    yield from (f"zip {n}" for n in ZIPS)
    yield from (f"mlagents {n}" for n in MLAGENTS)
    yield from (f"script {n}" for n in SCRIPTS)


def written(case: str, folder: Path) -> tuple[Path, ReadOptions]:
    """The file of a case, and how it is read."""
    kind, _, name = case.partition(" ")
    if kind == "dict":
        return test_state_dicts.saved(folder, name), test_state_dicts.options(name)
    if kind == "zip":
        return saved_models.saved(name, folder), ReadOptions()
    place = ROOT / ("torchscript" if kind == "script" else "torch_checkpoint") / f"{name}.pt"
    sensors = test_modules.SENSORS.get(name, ()) if kind == "script" else ()
    return place, ReadOptions(trust_source=kind == "script", sensors=sensors)


@pytest.mark.parametrize("case", list(cases()))
def test_its_own_layers_give_what_was_read(case: str, tmp_path: Path, here: RuntimePool) -> None:
    path, options = written(case, tmp_path)
    ((model, policy),) = read_source(path, options).compile_models()
    if case.partition(" ")[2] in UNBUILT:
        assert model.original is None
        return
    assert model.original is not None
    assert model.original.runtime == "torch"
    with model.original.loadable() as (place, told):
        loaded = here.process("torch").load(place, **told)
    try:
        original = Original(loaded, policy.signature, policy.source)
        assert original.output_names, "it can be asked for something"
        compared = 0
        for sample in draw_cases(policy.signature):
            theirs = original.run(sample.feeds)
            ours = run_graph(policy.graph, sample.feeds, list(theirs))
            for name, numbers in theirs.items():
                decides = numbers.dtype.kind in "iu"
                np.testing.assert_allclose(ours[name], numbers, rtol=0 if decides else 2e-4, atol=2e-5, err_msg=name)
                compared += 1
        assert compared
    finally:
        loaded.unload()


@pytest.mark.parametrize("name", ["continuous_actions", "deterministic_discrete_actions", "recurrent_out"])
def test_a_checkpoint_is_judged_by_it(name: str, tmp_path: Path, here: RuntimePool) -> None:
    path = torch_checkpoint.FOLDER / "ppo_1_1_hybrid_lstm.pt"
    ran = export_model(path, "-o", tmp_path, "--to", "onnx", "--verify", "torch,onnxruntime", "--json")
    (policy,) = ran.json["policies"]
    assert policy["parity"]["original"] == "torch"
    assert any(c["output"] == name and c["passed"] for c in policy["parity"]["comparisons"])
    assert policy["parity"]["verdict"] == "passed"


def test_code_in_a_file_is_run_only_where_it_is_trusted(tmp_path: Path, here: RuntimePool) -> None:
    path = ROOT / "torchscript/isaac_gru_script.pt"
    verdicts = {}
    for trust in ((), ("--trust-source",)):
        ran = export_model("compare", path, path, "--verify", "torch,onnxruntime", "--json", *trust)
        verdicts[bool(trust)] = ran.json["reports"][0]["original"]
    assert verdicts == {False: None, True: "torch"}


def test_a_checkpoint_and_a_file_of_its_trainer_are_compared_in_their_own_runtimes(here: RuntimePool) -> None:
    place = torch_checkpoint.FOLDER / "ppo_1_1"
    ran = export_model("compare", f"{place}.pt", f"{place}.onnx", "--verify", "torch,onnxruntime", "--json")
    (report,) = ran.json["reports"]
    assert (report["original"], report["verdict"]) == ("torch", "passed")
