"""Where one run left its policy in several forms, they are one policy: the same contract, and the recorded numbers.

Forms: the frozen graph, the ``.nn``, the ``.onnx`` and the checkpoint. ``golden.npz`` holds what the trainer's own
TensorFlow computed; its arrays are found by the names of the frozen graph (else of the checkpoint) and fed to every
form by canonical name, that is by role. Recorded normal draws are fed as ``epsilon``. Of an action that is drawn the
log-probabilities are compared, and the draw itself where a form's sampler can be given the recorded one. ``b3s4`` (3
sequences of 4 steps) runs as four steps with the memory fed back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.difference import compare
from export_model.exporter.verify.tolerances import Tolerance, tolerance_for
from export_model.signatures.errors import DamagedFileError, ExportModelError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import FAR_CASES, draw_cases
from tests.corpus.conftest import SHARED

pytestmark = pytest.mark.corpus

Arrays = Mapping[str, np.ndarray]
#: What a run may have left, the one that its goldens are named after first.
FORMS = {"frozen": ("frozen_graph_def.pb", "*.bytes"), "checkpoint": ("*.index",), "onnx": ("*.onnx",), "nn": ("*.nn",)}


@dataclass(frozen=True)
class Refused:
    """A form that is not read, by the run's folder and the form."""

    error: type[ExportModelError]
    match: str
    reason: str


REFUSED = {
    ("0.10.1tf115-ppo-continuous", "nn"): Refused(
        DamagedFileError, "AddV2", "the converter of 0.10.1 did not know an op of TensorFlow 1.15 and left it out"
    ),
}
#: Forms that are of another training than the others in their folder.
APART = {
    ("miguelsuau+modified-ml-agents__ml-agents0.3_python_models_ppo-48fab8", "frozen"): "trained on after the freeze",
}
#: Folders that hold nothing that could be read, with the reason.
EMPTY = {"0.3.0-bc-discrete-recurrent": "its trainer could neither freeze nor save it; the goldens alone are kept"}
#: Parts of the contract that a form cannot say as the frozen graph does.
DIFFERENT: dict[str, dict[str, str]] = {
    "nn": {"outputs": "its converter drops outputs that Unity does not read"},
    "onnx": {"family": "tf2onnx leaves no op types from which 0.7 to 0.16 could be told apart more closely"},
}
#: A fork whose graph has no node called action, and two networks.
OUTPUTS = {"miguelsuau+modified-ml-agents__python_models_dqn-48fab8": {"best_action": Role.ACTION}}


def forms_in(folder: Path) -> dict[str, Path]:
    """Form → file. Of two frozen graphs the last is the run's (UFOGridWorld2.bytes is of another training)."""
    found = {}
    for form, patterns in FORMS.items():
        files = sorted(p for pattern in patterns for p in folder.glob(pattern))
        if files and (folder.name, form) not in APART:
            found[form] = files[-1]
    return found


RUNS = [*sorted(SHARED.glob("genuine/*")), *sorted(SHARED.glob("corpus/ckpt/*"))]
READ = [r for r in RUNS if r.name not in EMPTY]
PARAMETERS = [pytest.param(r, id=r.name[:70]) for r in READ] or [pytest.param(Path("absent"), id="shared-is-absent")]


def policies_of(run: Path) -> dict[str, list[Policy]]:
    """Form → the run's policies, one per brain, in graph order."""
    options = CompileOptions(outputs=OUTPUTS.get(run.name, {}))
    found = {}
    for form, path in forms_in(run).items():
        if (run.name, form) not in REFUSED:
            found[form] = read_source(path).policies(options)
    return found


def said(policy: Policy) -> dict[str, Any]:
    """What must be the same of the contract; names of the source, and what it says of itself, are its own."""
    content = policy.signature.to_dict()
    for entry in (*content["inputs"], *content["outputs"]):
        del entry["source"]
        entry.pop("distribution", None)
    del content["notes"]
    content["outputs"] = {entry["name"]: entry for entry in content["outputs"]}
    return content


def assert_same_contract(mine: Policy, first: Policy, form: str) -> None:
    ours, theirs = said(mine), said(first)
    for key, reason in DIFFERENT.get(form, {}).items():
        if key == "outputs":
            assert ours[key].keys() <= theirs[key].keys(), reason
            assert {"action", "deterministic_action"} <= ours[key].keys()
            theirs[key] = {name: theirs[key][name] for name in ours[key]}
        else:
            del ours[key], theirs[key]
    assert ours == theirs


def close(policy: Policy, name: str, expected: np.ndarray, got: np.ndarray, where: str) -> None:
    difference = compare(expected, got, tolerance_for(policy.signature, name, Tolerance()))
    assert difference.passed, f"{where}: {name}: {difference}"


#: Inputs where rounding alone is more than the tolerance; verification measures it, this test does not.
_ROUNDED = ("1e3", *FAR_CASES)
#: In all other inputs noise is far, and SAC's log(1 − tanh² + ε) cancels.
_NEAR_NOISE = ("typical", "pixels")
#: Where tanh is 1 but for a unit in the last place: log(1 + 2⁻²⁴ / ε) of ε = 1e-6. Measured: 0.0474 in 5 runs, of one
#: element in 8,192 of the largest batch, and of up to a quarter elsewhere.
_SATURATED, _RARE, _OFTEN = Tolerance(0.06, 1e-5, "tanh² is 1 or the number below"), 1e-3, 0.3


@pytest.mark.parametrize("run", PARAMETERS)
def test_the_forms_of_a_run_are_one_policy(run: Path, is_new: Callable[[str, Sequence[Policy]], bool]) -> None:
    """Forms of policies that have nothing new are compared on typical inputs alone."""
    found = policies_of(run)
    assert found
    first, *others = found
    every = is_new("forms of a run", [policy for policies in found.values() for policy in policies])
    for form in others:
        for mine, reference in zip(found[form], found[first], strict=True):
            assert_same_contract(mine, reference, form)
            names = [s.name for s in mine.signature.outputs if s.role is not Role.SAMPLED]
            for case in draw_cases(reference.signature, seed=5, samples=1):
                if case.name in _ROUNDED or not (every or case.name.startswith(_NEAR_NOISE)):
                    continue
                ours, theirs = (run_graph(p.graph, case.feeds, names) for p in (mine, reference))
                for name in names:
                    where = f"{form}, {case.name}"
                    if reference.signature.output(name).role is Role.ACTION_PROBS:
                        near = case.name.startswith(_NEAR_NOISE)
                        assert_close_but_for_saturated(reference, name, theirs[name], ours[name], where, near=near)
                    else:
                        close(reference, name, theirs[name], ours[name], where)


def assert_close_but_for_saturated(
    policy: Policy, name: str, expected: np.ndarray, got: np.ndarray, where: str, *, near: bool
) -> None:
    """Few elements are off, none by more than saturation explains: what is × 0, or an element of it, is off by more."""
    held = tolerance_for(policy.signature, name, Tolerance())
    assert (found := compare(expected, got, _SATURATED)).passed, f"{where}: {name}: {found}"
    beyond = np.abs(got.astype(np.float64) - expected) > held.atol + held.rtol * np.abs(expected)
    assert beyond.mean() <= (_RARE if near else _OFTEN), f"{where}: {name}"
    if len(expected) > 1:
        assert not compare(expected, expected * 0, _SATURATED).passed


# ------------------------------------------------------------------ goldens


def recorded(archive: Arrays, run: str, part: str, name: str) -> np.ndarray | None:
    return archive.get(f"{run}/{part}/{node_of(name)}")


def played(policy: Policy, reference: Policy, archive: Arrays, run: str) -> Iterator[tuple[str, Arrays, Arrays]]:
    """Per step: (its name, what the policy gives, what was recorded), by canonical name."""
    signature, memory = reference.signature, reference.signature.memory
    into, out = (memory.input, memory.output) if memory is not None else (None, None)
    feeds: dict[str, np.ndarray] = {}
    for spec in signature.inputs:
        assert isinstance(spec.source, str)
        for part in ("in", "rand"):
            array = recorded(archive, run, part, spec.source)
            if array is not None:
                feeds[spec.name] = array
    assert feeds.keys() == {s.name for s in signature.inputs}
    expected = {
        s.name: array
        for s in signature.outputs
        if isinstance(s.source, str) and (array := recorded(archive, run, "out", s.source)) is not None
    }
    draws = {
        n.name: array
        for n in policy.graph.nodes
        if n.op == "Multinomial" and (array := recorded(archive, run, "rand", str(n.origin))) is not None
    }
    samplers = {n.name for n in policy.graph.nodes if n.op == "Multinomial"}
    steps = 4 if run.endswith("s4") else 1
    state = feeds[into] if into is not None else None
    names = [s.name for s in policy.signature.outputs]
    for step in range(steps):
        current = {n: a if n == into else a[step::steps] for n, a in {**feeds, **draws}.items()}
        if into is not None and state is not None:
            current[into] = state
        got = run_graph(policy.graph, current, names)
        state = None if out is None else got.get(out)
        wanted = {n: a if n == out else a[step::steps] for n, a in expected.items()}
        if step < steps - 1 and out is not None:
            wanted.pop(out, None)  # the golden has the memory after the last step only
        if samplers != draws.keys():
            wanted = {n: a for n, a in wanted.items() if signature.output(n).role is not Role.SAMPLED}
        yield f"{run} step {step}", got, {n: a for n, a in wanted.items() if n in got}


@pytest.mark.parametrize("run", [p for p in PARAMETERS if "corpus" not in str(p.values[0])])
def test_every_form_gives_what_the_trainer_computed(run: Path) -> None:
    archive = dict(np.load(run / "golden.npz"))
    found = policies_of(run)
    names = next(iter(found))
    compared = dict.fromkeys(found, 0)
    for form, policies in found.items():
        for policy, reference in zip(policies, found[names], strict=True):
            memory = reference.signature.memory
            fed_back = memory is not None and memory.input is not None and memory.output is not None
            for name in sorted({key.split("/")[0] for key in archive}):
                if name.endswith("s4") and not fed_back:
                    continue
                for where, got, wanted in played(policy, reference, archive, name):
                    for output, value in wanted.items():
                        close(reference, output, value, got[output], f"{form}, {where}")
                        compared[form] += 1
    assert min(compared.values()) >= 3


# ------------------------------------------------------------------ nothing is left out


def test_what_is_refused_is_refused_with_the_reason() -> None:
    for (folder, form), refused in REFUSED.items():
        with pytest.raises(refused.error, match=refused.match) as caught:
            read_source(forms_in(SHARED / "genuine" / folder)[form])
        assert caught.value.fix is not None
        assert "frozen_graph_def.pb" in caught.value.fix


def test_what_is_empty_is_empty() -> None:
    for folder in EMPTY:
        assert not forms_in(SHARED / "genuine" / folder)


def test_no_run_falls_out_unseen() -> None:
    """89 genuine runs and 9 public ones, by what they left."""
    counts = {form: sum(form in forms_in(r) for r in RUNS) for form in FORMS}
    assert len(RUNS) == 98
    assert counts == {"frozen": 95, "checkpoint": 49, "onnx": 24, "nn": 47}
