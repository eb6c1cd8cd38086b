"""What the weights do not tell is refused with what to do; run folders; the command line."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.recognise import recognise_path
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, SourceError, UsageError
from export_model.signatures.roles import Role
from fixtures.torch_checkpoint import FOLDER
from fixtures.torch_checkpoint.cases import CASES, waves
from tests.commands import export_model
from tests.exporting import inspect_model
from tests.torch_checkpoint.pt_files import Writer, actor, checkpoint, weights, zipped

SAID = {c.name: c for c in CASES if not c.stored}
IMAGES = {name: c for name, c in SAID.items() if any(len(s) == 3 for s in c.sensors)}


def placed(folder: Path, tensors: Any, name: str = "checkpoint.pt") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(checkpoint(tensors))
    return path


def image(folder: Path, name: str) -> Path:
    return placed(folder, weights(FOLDER / f"{name}.json"))


# ------------------------------------------------------------------ other files


@pytest.mark.parametrize(
    ("names", "maker"),
    [
        ({"actor.preprocess.model.model.0.weight": None}, "Tianshou"),
        ({"model.model.model.0.weight": None}, "Tianshou"),
        ({"encoder.actor_encoder.net.mlp.0.weight": None}, "RLlib"),
        ({"_logits._model.0.weight": None, "_hidden_layers.0._model.0.weight": None}, "RLlib"),
    ],
)
def test_checkpoints_of_other_trainers_are_named(
    names: dict[str, list[str] | None], maker: str, tmp_path: Path
) -> None:
    ones = np.ones((2, 3), np.float32)
    writer = Writer()
    alone = {k: ones for k, inner in names.items() if inner is None}
    parts = {k: writer.state(dict.fromkeys(inner, ones)) for k, inner in names.items() if inner is not None}
    (tmp_path / "agent.pt").write_bytes(writer.zip(parts or writer.state(alone)))
    with pytest.raises(NotAPolicyError, match=f"is a checkpoint of {maker}, .*\n.*\n.*load it in {maker}"):
        read_source(tmp_path / "agent.pt")


def test_a_checkpoint_of_rllib_is_a_folder_without_a_model(tmp_path: Path) -> None:
    (tmp_path / "rllib_checkpoint.json").write_text("{}")
    with pytest.raises(SourceError, match="it is a checkpoint of RLlib"):
        read_source(tmp_path)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"model": 1, "optimizer": 2}, "it holds model, optimizer"),
        ({"Policy": {}, "global_step": 1}, "it holds Policy, global_step"),
        ([1, 2], "it holds a list"),
        (None, "it holds a nonetype"),
    ],
)
def test_another_checkpoint_is_refused_with_what_it_holds(value: Any, words: str, tmp_path: Path) -> None:
    for data in (Writer().zip(value), Writer().row(value)):
        (tmp_path / "a.pth").write_bytes(data)
        with pytest.raises(NotAPolicyError, match="must be a checkpoint of a policy") as caught:
            read_source(tmp_path / "a.pth")
        assert words in str(caught.value)
        assert "torch.onnx.export" in str(caught.value)


def test_torchscript_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.pt").write_bytes(zipped({"a/data.pkl": b"\x80\x02}.", "a/constants.pkl": b"", "a/code/m.py": b""}))
    with pytest.raises(NotAPolicyError, match="TorchScript"):
        read_source(tmp_path / "a.pt")


def test_the_kind_is_told_by_content(tmp_path: Path) -> None:
    for name in ("ppo_1_1", "poca_0_26_discrete"):
        shutil.copy(FOLDER / f"{name}.pt", tmp_path / "a.bytes")
        assert recognise_path(Fetched(tmp_path / "a.bytes")).key == "torch_checkpoint"


def test_the_actors_own_state_dictionary_is_read_too(tmp_path: Path) -> None:
    writer = Writer()
    (tmp_path / "actor.pt").write_bytes(writer.zip(writer.state(actor())))
    (policy,) = read_source(tmp_path / "actor.pt").policies()
    assert policy.name == "actor"


# ------------------------------------------------------------------ networks that are not built


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ("network_body.observation_encoder.rsa.fc_q.weight", "rsa.fc_q.weight"),
        ("network_body.processors.0.self_embedder.seq_layers.0.weight", "a plugin"),
        ("network_body._body_endoder._hidden_layers.0.weight", "_hidden_layers.0.weight"),
        ("network_body.my_layer.weight", "network_body.my_layer.weight"),
        ("action_model._continuous_distribution.other", "action_model._continuous_distribution.other"),
    ],
)
def test_parts_that_are_not_read_are_refused_by_name(part: str, words: str, tmp_path: Path) -> None:
    path = placed(tmp_path, {**actor(), part: waves(part, (4, 3))})
    with pytest.raises(SourceError, match="not read from a checkpoint") as caught:
        read_source(path)
    assert words in str(caught.value)
    assert "mlagents-learn" in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"action_model___continuous_distribution__mu__bias": None},
            "has no action_model._continuous_distribution.mu.bias",
        ),
        (
            {"network_body___body_endoder__seq_layers__0__bias": np.zeros(3, np.float32)},
            "seq_layers.0.bias has the shape",
        ),
        ({"network_body___body_endoder__seq_layers__0__weight": None}, "seq_layers.0.weight"),
        ({"version_number": np.zeros(2, np.float32)}, "version_number has the shape"),
    ],
)
def test_weights_that_do_not_fit_are_named(changed: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError) as caught:
        read_source(placed(tmp_path, actor(**changed)))
    assert words in str(caught.value)


def test_a_policy_without_actions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError, match="has no action"):
        read_source(placed(tmp_path, actor(actions=0)))


def sac() -> dict[str, Any]:
    """A small actor whose deviation depends on the observation."""
    head = "action_model___continuous_distribution__log_sigma"
    return actor(**{head: None, f"{head}__weight": waves("s", (2, 4)), f"{head}__bias": waves("b", (2,))})


def test_the_optimizers_say_which_trainer_it_was(tmp_path: Path) -> None:
    for optimizer, tensors, trainer in (
        ("Optimizer:entropy_optimizer", sac(), "SAC"),
        ("Optimizer:value_optimizer", actor(), "PPO"),
        ("Optimizer", actor(), "PPO"),
        ("Optimizer:adam", actor(), "POCA"),
    ):
        (tmp_path / "a.pt").write_bytes(checkpoint(tensors, **{optimizer: {}}))
        (policy,) = read_source(tmp_path / "a.pt").policies()
        assert policy.signature.algorithm == trainer
        assert not any("is taken to" in note for note in policy.signature.notes)


def test_without_an_optimizer_a_note_says_what_is_assumed(tmp_path: Path) -> None:
    for tensors, assumed in ((sac(), True), (actor(), False)):
        (policy,) = read_source(placed(tmp_path, tensors)).policies()
        assert any("tanh is taken to bound" in note for note in policy.signature.notes) == assumed


@pytest.mark.parametrize("squashed", [True, False], ids=("tanh", "a clip"))
@pytest.mark.parametrize("saved", [{}, {"Optimizer:entropy_optimizer": {}}, {"Optimizer:value_optimizer": {}}], ids=str)
@pytest.mark.parametrize("conditional", [True, False], ids=("depends", "free"))
def test_the_onnx_beside_says_what_bounds_the_action(
    conditional: bool, saved: dict[str, Any], squashed: bool, tmp_path: Path
) -> None:
    """ML-Agents writes one with each checkpoint; its own trainers, told by their optimizers, need none."""
    path = tmp_path / "a.pt"
    path.write_bytes(checkpoint(sac() if conditional else actor(), **saved))
    nodes = [onnx.helper.make_node("Tanh" if squashed else "Clip", ["x"], ["y"])]
    path.with_suffix(".onnx").write_bytes(
        onnx.helper.make_model(onnx.helper.make_graph(nodes, "g", [], [])).SerializeToString()
    )
    own = bool(saved) and conditional == ("Optimizer:entropy_optimizer" in saved)
    (policy,) = read_source(path).policies()
    assert any(n.op == "Tanh" for n in policy.graph.nodes) == (conditional if own else squashed)
    said = [n for n in policy.signature.notes if "bound" in n]
    assert own != any(f"a.onnx, beside it, says that {'tanh' if squashed else 'a clip'}" in n for n in said), said
    path.with_suffix(".onnx").write_bytes(b"\x3a\xff")  # of no nodes: it says nothing
    if own or not saved:
        (policy,) = read_source(path).policies()
        assert any(n.op == "Tanh" for n in policy.graph.nodes) == conditional
    else:
        with pytest.raises(SourceError, match="a clip, or tanh"):
            read_source(path)


def test_an_action_whose_bound_is_not_known_is_refused(tmp_path: Path) -> None:
    for optimizer, tensors in (("Optimizer:entropy_optimizer", actor()), ("Optimizer:value_optimizer", sac())):
        (tmp_path / "a.pt").write_bytes(checkpoint(tensors, **{optimizer: {}}))
        with pytest.raises(SourceError, match="a clip, or tanh"):
            read_source(tmp_path / "a.pt")


# ------------------------------------------------------------------ sensors


@pytest.mark.parametrize("name", SAID)
def test_what_is_missing_is_refused_with_the_flag_that_says_it(name: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError) as caught:
        read_source(image(tmp_path, name))
    assert caught.value.fix is not None and "--sensors" in caught.value.fix


def test_the_shapes_are_kept_for_another_look_at_the_source(tmp_path: Path) -> None:
    """inspect takes them too, and verify --source finds them in policy.json."""
    source = image(tmp_path, "resnet_1_1")
    shapes = ",".join("x".join(map(str, s)) for s in IMAGES["resnet_1_1"].sensors)
    inspected = export_model("inspect", source, "--sensors", shapes, "--json")
    assert inspected.status == 0, inspected.err
    assert inspect_model(source, sensors=IMAGES["resnet_1_1"].sensors).policies
    exported = export_model(source, "-o", tmp_path / "out", "--sensors", shapes, "--verify", "none")
    assert exported.status == 0, exported.err
    (folder,) = (tmp_path / "out").iterdir()
    again = export_model("verify", folder, "--source", source, "--runtimes", "numpy", "--allow-unverified")
    assert again.status == 0, again.err


def test_the_sizes_that_would_fit_are_listed(tmp_path: Path) -> None:
    with pytest.raises(SourceError) as caught:
        read_source(image(tmp_path, "resnet_1_1"))
    assert "3x15x15" in str(caught.value)  # the smallest that ML-Agents takes: 15, 7, 3, 1


def test_an_image_of_which_only_one_size_fits_needs_no_flag(tmp_path: Path) -> None:
    """match3 on the smallest board: every larger one leaves more numbers."""
    tensors = weights(FOLDER / "match3_1_1.json")
    for name, array in tensors.items():
        if name.endswith("processors.0.dense.0.weight"):
            tensors[name] = np.ascontiguousarray(array[:, :144])
    (policy,) = read_source(placed(tmp_path, tensors)).policies()
    assert [s.shape for s in policy.signature.inputs if s.role is Role.VISUAL] == [(None, 2, 5, 5)]


@pytest.mark.parametrize(
    ("name", "sensors", "words"),
    [
        ("simple_1_1", ((1, 21, 24),), "takes 9 columns, and these sensors give 6"),
        ("simple_1_1", ((1, 84, 84), (3,)), "was not built for an image"),
        ("simple_1_1", ((3, 21, 24), (3,)), "was not built for an image"),
        ("simple_1_1", ((3,), (1, 21, 24)), "is an image"),
        ("simple_0_25", ((2,), (3, 20, 36)), "has 3 numbers"),
        ("simple_0_25", ((3,),), "has 2 sensors"),
        ("simple_0_25", ((3,), (3, 20, 36), (3, 20, 36)), "is a vector"),
        ("dense_1_1", ((2, 3, 5), (3,)), "was not built for an image"),
        ("simple_0_22", ((3, 20, 28),), "columns"),
        ("simple_0_22", ((3, 2, 2), (3,)), "was not built for an image"),
        ("attention_1_1", ((3,), (4, 5), (6, 2)), "a list of entities of 4 numbers"),
        ("attention_1_1", ((3,), (3,), (6, 2)), "a list of entities of 4 numbers"),
        ("attention_1_1", ((2, 3), (5, 4), (6, 2)), "no list of entities"),
        ("attention_alone_1_1", ((5, 4), (3,)), "takes 0 columns"),
    ],
)
def test_sensors_that_do_not_fit_are_refused(
    name: str, sensors: tuple[tuple[int, ...], ...], words: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="does not fit the checkpoint") as caught:
        read_source(image(tmp_path, name), ReadOptions(sensors=sensors))
    assert words in str(caught.value)


def test_a_goal_is_told_by_its_width_or_by_the_user(tmp_path: Path) -> None:
    """Goals of the width of another sensor are not guessed."""
    path = image(tmp_path, "goal_1_1")
    graphs = [read_source(path, ReadOptions(sensors=((4,), (3,)), goals=g)).models[0].graph for g in ((), (1,))]
    by_width, marked = ([(n.name, n.inputs) for n in graph.nodes] for graph in graphs)
    assert by_width == marked
    with pytest.raises(SourceError, match="which of the agent's sensors is its goal") as caught:
        read_source(path, ReadOptions(sensors=((3,), (3,), (1,))))
    assert "--sensors" in str(caught.value) and "goal:" in str(caught.value)
    with pytest.raises(UsageError, match="does not fit the checkpoint"):
        read_source(path, ReadOptions(sensors=((4,), (3,)), goals=(0,)))
    exported = export_model(path, "-o", tmp_path / "out", "--sensors", "4,goal:3", "--verify", "none")
    assert exported.status == 0, exported.err
    (folder,) = (tmp_path / "out").iterdir()
    assert Bundle.open(folder).contract.origin.goals == (1,)


# ------------------------------------------------------------------ the command line and run folders


def test_the_command_line(tmp_path: Path) -> None:
    path = image(tmp_path, "nature_1_1")
    refused = export_model(path, "-o", tmp_path / "out", "--verify", "none")
    assert refused.status == 2 and "--sensors" in refused.err and not (tmp_path / "out").exists()
    done = export_model(path, "-o", tmp_path / "out", "--verify", "none", "--sensors", "2,3x36x45")
    assert done.status == 0, done.err
    assert (tmp_path / "out/checkpoint/checkpoint.onnx").is_file()
    for text in ("2,3x", "2,x", "two", "2,3x0x4", "2,3x99999999999x4"):
        wrong = export_model(path, "-o", tmp_path / "out", "--sensors", text)
        assert wrong.status == 2 and "is not the shape of a sensor" in wrong.err


def names_read(path: Path, step: int | None = None) -> dict[str, list[str]]:
    source = read_source(path, ReadOptions(step))
    return {str(m.name): [p.name for p in m.files] for m in source.models}


def test_a_run_folder_that_has_only_checkpoints(tmp_path: Path) -> None:
    """What is left when the export to ONNX failed: the newest step, or the one that is asked for."""
    run = tmp_path / "results/first"
    for name in ("Hop/Hop-500.pt", "Hop/Hop-1000.pt", "Hop/checkpoint.pt"):
        placed(run, actor(), name)
    assert names_read(run) == {"Hop": ["Hop-1000.pt"]}
    assert names_read(run, 500) == {"Hop": ["Hop-500.pt"]}
    assert names_read(run / "Hop") == {"Hop": ["Hop-1000.pt"]}


def test_the_last_checkpoint_alone(tmp_path: Path) -> None:
    placed(tmp_path / "results/first", actor(), "Hop/checkpoint.pt")
    assert names_read(tmp_path / "results/first") == {"Hop": ["checkpoint.pt"]}


def test_a_final_onnx_goes_before_checkpoints(tmp_path: Path) -> None:
    run = tmp_path / "results/first"
    for name in ("Hop/Hop-500.pt", "Hop/checkpoint.pt"):
        placed(run, actor(), name)
    shutil.copy(FOLDER / "ppo_1_1.onnx", run / "Hop/Hop-500.onnx")
    assert names_read(run) == {"Hop": ["Hop-500.onnx"]}
    shutil.copy(FOLDER / "ppo_1_1.onnx", run / "Hop.onnx")
    assert names_read(run) == {"Hop": ["Hop.onnx"]}


def test_a_checkpoint_that_is_newer_than_every_export_is_read(tmp_path: Path) -> None:
    run = tmp_path / "results/first"
    for name in ("Hop/Hop-500.pt", "Hop/Hop-1000.pt", "Hop/checkpoint.pt"):
        placed(run, actor(), name)
    shutil.copy(FOLDER / "ppo_1_1.onnx", run / "Hop/Hop-500.onnx")
    assert names_read(run) == {"Hop": ["Hop-1000.pt"]}


def test_sensors_reach_the_checkpoint_in_a_run_folder(tmp_path: Path) -> None:
    placed(tmp_path / "results/a", weights(FOLDER / "simple_1_1.json"), "Hop/checkpoint.pt")
    (model,) = read_source(tmp_path / "results/a", ReadOptions(sensors=((1, 21, 24), (3,)))).models
    assert model.name == "Hop"
