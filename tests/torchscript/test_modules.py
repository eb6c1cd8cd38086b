"""TorchScript modules against what PyTorch gave of them, step by step (fixtures/torchscript)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.torchscript_archive import ScriptArchive
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from fixtures.goldens import read_npz
from fixtures.torchscript import AGENTS, FOLDER, STEPS

NAMES = sorted(p.stem for p in FOLDER.glob("*.pt"))
ATOL, RTOL = 2e-6, 2e-5
#: What the code of a scripted module does not say.
SENSORS = {"convolved_script": ((55,),), "seeing_script": ((1, 13, 16), (5,)), "chosen_script": ((10,),)}
SENSORS |= {"painted_script": ((3, 12, 12),)}
_MEMORY_IN, _MEMORY_OUT = "recurrent_in", "recurrent_out"


def compiled(name: str) -> Policy:
    (policy,) = read_source(FOLDER / f"{name}.pt", ReadOptions(sensors=SENSORS.get(name, ()))).policies()
    return policy


@pytest.mark.parametrize("name", NAMES)
def test_gives_what_the_module_gives_step_by_step(name: str) -> None:
    """Several agents at a time, each with its own memory, which is zero at the start and fed back."""
    policy, golden = compiled(name), read_npz(FOLDER / f"{name}.npz")
    given = {k.removeprefix("in/"): v for k, v in golden.items() if k.startswith("in/")}
    signature = policy.signature
    outputs = [s.name for s in signature.outputs]
    memory = next(
        (np.zeros((AGENTS, s.shape[1] or 0), np.float32) for s in signature.inputs if s.name == _MEMORY_IN), None
    )
    assert (memory is not None) == any(
        k in name for k in ("lstm", "gru", "remembered", "shifted", "cells", "states", "hidden")
    )
    for step in range(STEPS):
        feeds = {s.name: given[str(s.source)][:, step] for s in signature.inputs if s.name != _MEMORY_IN}
        if memory is not None:
            feeds[_MEMORY_IN] = memory
        answers = run_graph(policy.graph, feeds, outputs)
        memory = answers.get(_MEMORY_OUT)
        wanted = golden["out"][:, step]
        assert answers["action"] == pytest.approx(wanted, abs=ATOL, rel=RTOL), step
    assert len(np.unique(golden["out"].reshape(-1, golden["out"].shape[-1]), axis=0)) > 1


def test_what_a_trace_was_given_may_be_larger_than_the_file() -> None:
    """The archive has the shapes of it, and empty storages."""
    traced = ScriptArchive((FOLDER / "painted_trace.pt").read_bytes()).traced["forward"][0]
    assert traced.shape == (64, 3, 12, 12)
    assert 4 * np.prod(traced.shape) > (FOLDER / "painted_trace.pt").stat().st_size


def test_states_that_are_given_back_are_one_memory() -> None:
    signature = compiled("states_trace").signature
    assert [s.name for s in signature.inputs] == ["state", _MEMORY_IN]
    assert signature.input(_MEMORY_IN).shape == (None, 2 * 2 * 6)
    assert signature.memory is not None and signature.memory.layout == ("h", "c")


def test_the_fixtures_have_modules_of_every_kind() -> None:
    assert len(NAMES) >= 20
    assert {n.rpartition("_")[2] for n in NAMES} == {"script", "trace"}
    assert Path(FOLDER / "legged_lstm_script.pt").stat().st_size < 1 << 16
