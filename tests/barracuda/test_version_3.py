"""Genuine memories as a ``.nn`` of API version 3 (release 17 to 20): by the layer rules, fed as ML-Agents feeds it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.consumers.profiles import profile
from export_model.converters.formats.barracuda.format import parse
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.signatures.roles import Role
from tests.barracuda.conftest import params
from tests.corpus.conftest import genuine_cases
from tests.corpus.test_goldens import Golden, rows
from tests.targets.dressed import Pair, compiled

CASES = {f: c for f, c in genuine_cases() if "recurrent" in f.name and f.name != "0.3.0-bc-continuous-recurrent"}


@pytest.mark.corpus
@pytest.mark.parametrize("folder", params(list(CASES), lambda f: f.name))
def test_a_genuine_memory_is_what_its_trainer_recorded(folder: Path, shared: Path) -> None:
    archive = dict(np.load(folder / "golden.npz"))
    for policy in compiled(folder / CASES[folder]["frozen"]["file"]):
        pair = Pair.of(policy, profile("barracuda-3"), form="nn")
        model, memory = parse(pair.data), policy.signature.memory
        assert memory is not None and memory.input is not None and memory.output is not None
        scores = [layer.inputs[0] for layer in model.layers if layer.type == LayerType.MULTINOMIAL]
        compared = 0
        for run in sorted({key.split("/")[0] for key in archive}):
            golden = Golden(archive, run, policy)
            steps = 4 if run.endswith("s4") else 1
            feeds, expected = golden.feeds(), golden.expected()
            state = feeds[memory.input]
            for step in range(steps):
                current = {**rows(feeds, step, steps, memory.input), memory.input: state}
                recorded = rows(expected, step, steps, memory.output)
                values = pair.values(model, current)
                state = values["recurrent_out"].reshape(len(state), -1).astype(np.float32)
                found: dict[str, Any] = {memory.output: state} if step == steps - 1 else {}
                if "continuous_actions" in values:
                    found["action"] = values["continuous_actions"].reshape(len(state), -1)
                if scores:
                    found["action_log_probs"] = np.concatenate([values[n].reshape(len(state), -1) for n in scores], 1)
                for name, value in found.items():
                    drawn = name in recorded and policy.signature.output(name).role is Role.SAMPLED
                    if name in recorded and not drawn:
                        np.testing.assert_allclose(value, recorded[name].reshape(value.shape), atol=2e-5, rtol=2e-5)
                        compared += 1
        assert compared >= 2
