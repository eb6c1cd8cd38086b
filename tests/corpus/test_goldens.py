"""golden.npz of the genuine cases, which the trainers' own TensorFlow computed, in the runtimes.

Every case in numpy, in onnxruntime and (the original) in today's TensorFlow, one in six in all.

Normal draws are fed as ``epsilon``. Multinomial draws are fed to the original and to the numpy reference only; the
other runtimes draw for themselves, so their log-probabilities are compared. ``b3s4`` (3 sequences of 4 steps) runs as
four steps with the memory fed back.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.children.process import LoadedModel
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.difference import compare
from export_model.exporter.verify.tolerances import Tolerance, tolerance_for
from export_model.signatures.roles import Role
from tests import known
from tests.conftest import FULL, NEEDED
from tests.corpus.conftest import genuine_cases

pytestmark = [pytest.mark.corpus, pytest.mark.slow]

Arrays = Mapping[str, np.ndarray]
QUICK = ("numpy", "onnxruntime")
CASES = [
    pytest.param(f, c, QUICK if number % 6 and FULL not in os.environ else ("numpy", *NEEDED), id=f.name)
    for number, (f, c) in enumerate(genuine_cases())
] or [pytest.param(Path("absent"), {}, QUICK, id="shared-is-absent")]


def node(tensor: str) -> str:
    return tensor.rpartition(":")[0] or tensor


class Golden:
    """One run of a golden.npz, seen through a policy's contract."""

    def __init__(self, archive: Arrays, run: str, policy: Policy) -> None:
        self.archive, self.run, self.policy = archive, run, policy

    def feeds(self) -> dict[str, np.ndarray]:
        found = {}
        for spec in self.policy.signature.inputs:
            assert isinstance(spec.source, str)
            key = f"{self.run}/in/{node(spec.source)}"
            found[spec.name] = self.archive[key if key in self.archive else f"{self.run}/rand/{node(spec.source)}"]
        return found

    def draws(self) -> dict[str, np.ndarray]:
        """Multinomial draws by the node's name in the policy's graph and by the source's tensor."""
        found = {}
        for n in self.policy.graph.nodes:
            if n.op == "Multinomial" and n.origin is not None:
                found[n.name] = self.archive[f"{self.run}/rand/{node(n.origin)}"]
        return found

    def expected(self) -> dict[str, np.ndarray]:
        return {
            s.name: self.archive[f"{self.run}/out/{node(s.source)}"]
            for s in self.policy.signature.outputs
            if isinstance(s.source, str)
        }


def rows(arrays: Arrays, step: int, steps: int, memory: str | None) -> dict[str, np.ndarray]:
    """The rows of one step out of sequences laid end to end (row = sequence · steps + step)."""
    return {name: a if name == memory else a[step::steps] for name, a in arrays.items()}


Answer = Callable[[Arrays, Arrays], dict[str, np.ndarray]]


def answers(
    policy: Policy, folder: Path, pool: RuntimePool, source: Path, runtimes: Sequence[str]
) -> dict[str, tuple[Answer, bool]]:
    """Runtime → (how to run it, whether draws can be fed to it)."""
    outputs = [s.name for s in policy.signature.outputs]
    result: dict[str, tuple[Answer, bool]] = {}
    for target in DEFAULTS:
        artifact = WRITTEN[target].artifact(policy, WriteOptions("{}"))
        artifact.write(folder)
        for runtime in (r for r in WRITTEN[target].runtimes if r in runtimes):
            kind = {"kind": "saved_model"} if target == "saved_model" else {"kind": "graph"}
            model = pool.process(runtime).load(str(folder / artifact.main), **kind)
            feedable = runtime == "numpy"

            def run(feeds: Arrays, draws: Arrays, model: LoadedModel = model, feedable: bool = feedable) -> Any:
                return model.run({**feeds, **(draws if feedable else {})}, outputs)

            result[f"{target} in {runtime}"] = (run, feedable)
    original = pool.process("tensorflow").load(str(source), kind="graph")
    origins = {n.name: n.origin for n in policy.graph.nodes if n.op == "Multinomial"}

    def run_original(feeds: Arrays, draws: Arrays) -> dict[str, np.ndarray]:
        placed = {policy.source.feeds[name]: array for name, array in feeds.items()}
        placed |= {name: np.asarray(value) for name, value in policy.source.fixed.items()}
        placed |= {origins[name] or name: array for name, array in draws.items()}
        fetches = policy.source.fetches
        values = original.run(placed, list(dict.fromkeys(fetches.values())))
        return {name: values[tensor] for name, tensor in fetches.items()}

    result["source in tensorflow"] = (run_original, True)
    return result


def check(policy: Policy, where: str, got: Arrays, expected: Arrays, drawn: bool) -> None:
    for name, value in expected.items():
        if policy.signature.output(name).role is Role.SAMPLED and not drawn:
            continue
        difference = compare(
            value, got[name], tolerance_for(policy.signature, name, Tolerance()), narrowed="tfjs" in where
        )
        assert difference.passed, f"{where}: {name}: {difference}"


@pytest.mark.parametrize(("folder", "case", "runtimes"), CASES)
def test_goldens_agree_in_the_runtimes(
    folder: Path, case: dict[str, Any], runtimes: Sequence[str], tmp_path: Path, pool: RuntimePool
) -> None:
    source = folder / case["frozen"]["file"]
    archive = dict(np.load(folder / "golden.npz"))
    runs = sorted({key.split("/")[0] for key in archive})
    for policy in known.policies_or_skip(source):
        named = answers(policy, tmp_path / policy.name, pool, source, runtimes)
        compared = 0
        for run in runs:
            golden = Golden(archive, run, policy)
            steps = 4 if run.endswith("s4") else 1
            memory = policy.signature.memory
            if steps > 1 and (memory is None or memory.input is None or memory.output is None):
                continue
            feeds, draws, expected = golden.feeds(), golden.draws(), golden.expected()
            scores: dict[str, np.ndarray] = {}
            decisions: dict[int, dict[str, np.ndarray]] = {}
            for where, (answer, feedable) in named.items():
                state = feeds[memory.input] if memory is not None and memory.input is not None else None
                for step in range(steps):
                    current = rows(feeds, step, steps, memory.input if memory else None)
                    if state is not None and memory is not None and memory.input is not None:
                        current[memory.input] = state
                    got = answer(current, rows(draws, step, steps, None))
                    wanted = rows(expected, step, steps, memory.output if memory else None)
                    if memory is not None and memory.output is not None:
                        state = got[memory.output]
                        if step < steps - 1:
                            wanted.pop(memory.output, None)  # the golden has the memory after the last step only
                    check(policy, f"{run} step {step}, {where}", got, wanted, feedable)
                    if "action_log_probs" in got:
                        first = scores.setdefault(f"{step}", got["action_log_probs"])
                        close = compare(first, got["action_log_probs"], Tolerance())
                        assert close.passed, f"{run}, {where}: action_log_probs: {close}"
                    if policy.signature.branches and where.startswith(("onnx in", "tfjs in js")):
                        plain = (s.name for s in policy.signature.outputs if s.role is Role.DETERMINISTIC)
                        decided = {n: got[n] for n in plain}
                        first = decisions.setdefault(step, decided)
                        assert all((first[n] == v).all() for n, v in decided.items()), f"{run}, {where}: decisions"
                    compared += 1
        assert compared >= 3 * len(named)
