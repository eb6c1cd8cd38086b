"""What --sensors says of a checkpoint of ML-Agents is what the export takes: each sensor, in its order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.roles import OBSERVATIONS, Role
from fixtures.torch_checkpoint import FOLDER
from fixtures.torch_checkpoint.cases import CASES, waves
from tests.commands import export_model
from tests.torch_checkpoint.pt_files import checkpoint, weights

UNITY = Path(__file__).resolve().parents[2] / "../shared/unity/r4"
AGENTS = {"cam_buffer": "3x20x24,3x4,2", "hybrid_norm": "6,4"}
#: A checkpoint of every generation whose vectors can be split: one normaliser for all, or none.
SPLIT = ("ppo_0_20", "ppo_0_22_lstm", "ppo_0_22_discrete", "sac_0_21", "sac_0_23", "sac_1_1")
JOINED = "how many vector sensors the"


def read(path: Path, sensors: str = "") -> Policy:
    shapes = tuple(tuple(map(int, shape.split("x"))) for shape in sensors.split(",") if shape)
    (policy,) = read_source(path, ReadOptions(sensors=shapes)).policies()
    return policy


def observations(policy: Policy) -> dict[str, tuple[str, tuple[int | None, ...]]]:
    return {str(s.source): (s.name, s.shape) for s in policy.signature.inputs if s.role in OBSERVATIONS}


@pytest.mark.parametrize("name", SPLIT)
def test_vectors_are_the_inputs_that_the_user_says(name: str) -> None:
    """Oracle: the same checkpoint with one input, whose answers ML-Agents' own modules gave (test_genuine.py)."""
    whole = read(FOLDER / f"{name}.pt")
    assert any(JOINED in note and "--sensors" in note for note in whole.signature.notes)
    (vector,) = (s for s in whole.signature.inputs if s.role is Role.VECTOR)
    width = int(vector.shape[-1] or 0)
    split = read(FOLDER / f"{name}.pt", f"{width - 2},2")
    assert observations(split) == {"obs_0": ("state", (None, width - 2)), "obs_1": ("state_1", (None, 2))}
    assert not any(JOINED in note for note in split.signature.notes)
    feeds = {s.name: np.abs(waves(s.name, (3, *(n or 0 for n in s.shape[1:])))) for s in whole.signature.inputs}
    parts = {**feeds, "state": feeds["state"][:, :-2], "state_1": feeds["state"][:, -2:]}
    names = [s.name for s in whole.signature.outputs if s.role is not Role.SAMPLED]
    wanted, found = run_graph(whole.graph, feeds, names), run_graph(split.graph, parts, names)
    for output in names:
        assert found[output] == pytest.approx(wanted[output], abs=1e-6), output


@pytest.mark.parametrize("case", [c for c in CASES if len(c.sensors) > 1], ids=lambda case: case.name)
def test_every_case_takes_the_sensors_of_its_agent(case, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Whatever its generation calls them, they are obs_0 … in the order of the flag, with its shapes."""
    path = FOLDER / f"{case.name}.pt"
    if not path.exists():
        path = tmp_path / "checkpoint.pt"
        path.write_bytes(checkpoint(weights(FOLDER / f"{case.name}.json"), "zip"))
    policy = read(path, ",".join("x".join(map(str, shape)) for shape in case.sensors))
    found = {name: shape for name, (_, shape) in observations(policy).items()}
    assert found == {f"obs_{i}": (None, *shape) for i, shape in enumerate(case.sensors)}


@pytest.mark.parametrize("name", AGENTS)
def test_unitys_own_agents_are_fed_in_their_order(name: str, tmp_path: Path) -> None:
    """The ``.pt`` with the agent's sensors computes what its ``.onnx`` does, and is written as Unity feeds it.

    The version number among its weights was drawn by chance: the names of its layers say how it was made.
    """
    if not UNITY.exists():
        pytest.skip(f"{UNITY} is not here")
    source, reference = UNITY / f"{name}.pt", read(UNITY / f"{name}.onnx")
    policy = read(source, AGENTS[name])
    assert observations(policy) == observations(reference)
    assert policy.signature.constants["version_number"] == 3
    feeds = {s.name: np.abs(waves(s.name, (3, *(n or 0 for n in s.shape[1:])))) for s in policy.signature.inputs}
    feeds["action_masks"] = np.ones_like(feeds["action_masks"])
    names = [s.name for s in policy.signature.outputs if s.role is not Role.SAMPLED]
    shared = [name for name in names if any(s.name == name for s in reference.signature.outputs)]
    assert "continuous_actions" in shared
    wanted, found = run_graph(reference.graph, feeds, shared), run_graph(policy.graph, feeds, shared)
    if name == "hybrid_norm":  # made with tanh, and without SAC's deviation or an optimiser, which would tell it
        assert any("hybrid_norm.onnx, beside it, says that tanh bounds" in note for note in policy.signature.notes)
        alone = tmp_path / source.name
        alone.write_bytes(source.read_bytes())
        assert any("a clip is taken to bound its action" in n for n in read(alone, AGENTS[name]).signature.notes)
    for output in shared:
        assert found[output] == pytest.approx(wanted[output], abs=1e-5), output
    made = export_model(source, "--sensors", AGENTS[name], "--for", "unity6", "-o", tmp_path, "--verify", "none")
    assert made.status == 0, made.err
    written = read(tmp_path / name / f"{name}.onnx")
    assert {k: shape for k, (_, shape) in observations(written).items()} == {
        f"obs_{i}": (None, *map(int, shape.split("x"))) for i, shape in enumerate(AGENTS[name].split(","))
    }
