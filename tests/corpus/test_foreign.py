"""../shared/foreign: policies of other trainers give their original modules' own numbers in every format.

Nothing of a policy is lost on the way: each output that the file has is an output of the export, each memory is fed
back. Outputs that are drawn are one draw of the original's and are left to the tests of distributions.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.source import ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.signatures.memories import SourcePart
from export_model.signatures.roles import OBSERVATIONS, Role
from tests.conftest import Chosen
from tests.corpus.conftest import SHARED

pytestmark = [pytest.mark.corpus, pytest.mark.slow]

FOREIGN = SHARED / "foreign"
#: The file says 1e-4 · (1 + |x|): torch and the kernels add in another order.
TOLERANCE = 1e-4
#: Files whose .json lists the outputs by name and whose recording has them in the model's order.
OUTPUTS = {"keras_lstm_state.keras": ["action", "h_out", "c_out"]}
FILES = sorted(p for end in ("onnx", "pt", "keras") for p in FOREIGN.glob(f"*.{end}")) or [
    Path("shared-is-absent.onnx")
]

Arrays = dict[str, np.ndarray]


def rows_of(archive: Mapping[str, np.ndarray], outputs: list[str]) -> Iterator[tuple[str, Arrays, Arrays]]:
    """(row and label, inputs by name, outputs by name) of a recording."""
    found: dict[str, tuple[Arrays, Arrays]] = {}
    for key, array in archive.items():
        number, label, side, name = key.split("|")
        inputs, answers = found.setdefault(f"{number}|{label}", ({}, {}))
        if side == "in":
            inputs[name] = array
        elif int(name) < len(outputs):
            answers[outputs[int(name)]] = array
    for row, (inputs, answers) in found.items():
        yield row, inputs, answers


def joined(parts: tuple[SourcePart, ...], arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """The memory's row per agent, from the source's separate ones."""
    columns = []
    for part in parts:
        array = np.moveaxis(arrays[part.tensor], part.shape.index(None), 0)
        columns.append(array.reshape(len(array), -1))
    return np.concatenate(columns, axis=1)


def feeds_of(policy: Policy, inputs: Arrays, rows: int) -> Arrays:
    feeds = {}
    for spec in policy.signature.inputs:
        if spec.name in policy.source.parts:
            feeds[spec.name] = joined(policy.source.parts[spec.name], inputs)
        elif isinstance(spec.source, str) and spec.source in inputs:
            given = inputs[spec.source]
            feeds[spec.name] = given.reshape(rows, *given.shape[1:]).astype(spec.dtype)
        else:
            assert spec.role is Role.NOISE, f"{spec.name} ({spec.role}) is not among the recorded inputs"
            feeds[spec.name] = np.zeros(tuple(rows if n is None else n for n in spec.shape), spec.dtype)
    return feeds


def drawn(policy: Policy) -> set[str]:
    """Outputs that depend on chance: noise that was recorded nowhere, or a sampler."""
    chance = {s.name for s in policy.signature.noise} | {n.name for n in policy.graph.nodes if n.op == "Multinomial"}
    return {s.name for s in policy.signature.outputs if policy.graph.ancestors([s.name]) & chance}


def compared(policy: Policy, answers: Arrays, expected: Arrays, where: str) -> int:
    count = 0
    for spec in policy.signature.outputs:
        if spec.name in drawn(policy):
            continue
        if spec.name in policy.source.parts:
            wanted = joined(policy.source.parts[spec.name], expected)
        else:
            kinds = ("deterministic_continuous_actions", "deterministic_discrete_actions")
            names = kinds if spec.name == "deterministic_action" else (spec.name,)
            found = next((n for n in (spec.source, *names) if n in expected and expected[n].size), None)
            if found is None:
                continue
            wanted = expected[found]
        got = answers[spec.name].reshape(wanted.shape)
        np.testing.assert_allclose(got, wanted, atol=TOLERANCE, rtol=TOLERANCE, err_msg=f"{where}: {spec.name}")
        count += 1
    return count


@pytest.mark.parametrize("file", FILES, ids=lambda p: p.name)
def test_the_trainers_own_numbers_come_out_of_every_format(
    file: Path, tmp_path: Path, pool: RuntimePool, runtimes_for: Chosen
) -> None:
    about: dict[str, Any] = json.loads(file.with_suffix(".json").read_text())
    with np.load(file.with_suffix(".npz")) as archive:
        outputs = OUTPUTS.get(file.name) or about.get("onnx_outputs") or about["outputs"]
        recorded = list(rows_of(dict(archive), outputs))
    said = sensors(recorded[0][1]) if file.suffix == ".pt" else ()
    (policy,) = read_source(file, ReadOptions(sensors=said)).policies()
    signature = policy.signature
    assert any(s.role in OBSERVATIONS for s in signature.inputs)
    if file.suffix != ".pt":
        nothing_is_lost(policy, about)
    models, chosen = {}, ("numpy", *runtimes_for([policy]))
    for target in WRITTEN:
        if not WRITTEN[target].default:
            continue
        artifact = WRITTEN[target].artifact(policy, WriteOptions("{}"))
        artifact.write(tmp_path)
        for runtime in (r for r in WRITTEN[target].runtimes if r in chosen):
            kind = {"kind": "saved_model"} if target == "saved_model" else {"kind": "graph"}
            models[f"{target} in {runtime}"] = pool.process(runtime).load(str(tmp_path / artifact.main), **kind)
    names = [s.name for s in signature.outputs]
    count = 0
    recorded = [r for r in recorded if not lost(about, r[1])]
    for row, inputs, expected in recorded:
        size = len(next(iter(inputs.values())))
        feeds = feeds_of(policy, {**renamed_inputs(about, inputs), **inputs}, size)
        for where, model in models.items():
            count += compared(policy, model.run(feeds, names), expected, f"{row}, {where}")
    for model in models.values():
        model.unload()
    assert count >= len(recorded) > 0 or set(names) <= drawn(policy) | {"deterministic_action"}


def lost(about: dict[str, Any], inputs: Arrays) -> bool:
    """Whether the recording gives something to an input that the file has not: torch traced it as the zero it was."""
    names = about.get("onnx_inputs") or inputs
    same = set(names) <= set(inputs)  # else the exporter called them otherwise
    return same and any(array.any() for name, array in inputs.items() if name not in names)


def sensors(inputs: Arrays) -> tuple[tuple[int, ...], ...]:
    """What --sensors says of a .pt, from the recorded observations."""
    return tuple(inputs[n].shape[1:] for n in sorted(n for n in inputs if n.startswith("obs_")))


def renamed_inputs(about: dict[str, Any], inputs: Arrays) -> Arrays:
    """Inputs under the file's own names, where torch's exporter gave others (and left out what nothing reads)."""
    return dict(zip(about.get("onnx_inputs") or (), inputs.values(), strict=False))


def nothing_is_lost(policy: Policy, about: dict[str, Any]) -> None:
    """Every output of the file that is no constant of ML-Agents is one of the export."""
    sources: set[str] = set()
    for spec in policy.signature.outputs:
        sources |= {spec.source} if isinstance(spec.source, str) else set(spec.source or ())
    constants = set(policy.signature.constants)
    duplicates = {"action"} if "continuous_actions" in sources or "discrete_actions" in sources else set()
    assert set(about["onnx_outputs"]) - constants - duplicates <= sources
