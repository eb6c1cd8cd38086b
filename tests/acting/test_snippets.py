"""``export-model snippets``: what is printed runs as printed, and gives what numpy gives."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.registry import DEFAULTS
from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.snippets.contract import read_bundle
from export_model.exporter.snippets.registry import TARGETS, snippets
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import Role
from fixtures import path as fixture
from tests.acting.snippet_bundles import NAMES, bundle_of, code_of
from tests.commands import PYTHONPATH, ROOT
from tests.commands import export_model as run
from tests.exporting import export_model, load_policy

SHARED = ROOT.parent / "shared"


def same(found: dict[str, Any], expected: dict[str, np.ndarray], policy: LoadedPolicy) -> None:
    drawn = {s.name for s in policy.signature.outputs if s.role is Role.SAMPLED}
    assert set(found) == set(expected)
    for name in set(expected) - drawn:
        np.testing.assert_allclose(np.array(found[name]), expected[name], atol=1e-5, rtol=1e-5, err_msg=name)
    for name in drawn:
        sizes = policy.signature.branches
        assert np.all((np.array(found[name]) >= 0) & (np.array(found[name]) < sizes))


def in_numpy(policy: LoadedPolicy, feeds: dict[str, Any]) -> dict[str, np.ndarray]:
    arrays = {s.name: np.array(feeds[s.name], s.dtype) for s in policy.signature.inputs}
    assert set(arrays) == set(feeds)
    return policy.run(arrays, [s.name for s in policy.signature.outputs])


# ------------------------------------------------------------------ Python


@pytest.fixture(scope="module")
def answers(out: Path) -> Callable[[str, str], dict[str, Any]]:
    """(target, policy) → what running its snippet left behind; all are run in one process, when one is asked for."""

    @functools.cache
    def ran() -> dict[tuple[str, str], Any]:
        jobs: dict[tuple[str, str], Any] = {}
        for name in NAMES:
            for target in ("onnxruntime", "saved-model", "serving-grpc", "load-policy"):
                jobs[target, name] = {"kind": "python", "code": code_of(out, name, target)}
            jobs["serving-rest", name] = {"kind": "rest", "name": name, "body": rest_body(out, name)}
        environment = {**os.environ, "PYTHONPATH": PYTHONPATH, "TF_CPP_MIN_LOG_LEVEL": "3", "CUDA_VISIBLE_DEVICES": ""}
        command = [sys.executable, str(Path(__file__).with_name("run_snippets.py"))]
        done = subprocess.run(
            command, input=json.dumps(list(jobs.values())), capture_output=True, text=True, cwd=out, env=environment
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return dict(zip(jobs, json.loads(done.stdout), strict=True))

    def answer(target: str, name: str) -> dict[str, Any]:
        for needed in ("tensorflow", "onnxruntime"):
            if importlib.util.find_spec(needed) is None:
                pytest.skip(f"{needed} is not installed: pip install export-model[all]")
        found: dict[str, Any] = ran()[target, name]
        return found

    return answer


def rest_body(out: Path, name: str) -> Any:
    """What the printed command posts: it is run with a curl that prints the body."""
    tools = out / ".tools"
    tools.mkdir(exist_ok=True)
    curl = tools / "curl"
    curl.write_text('#!/bin/sh\nfor last; do :; done\n[ "$last" = @- ] && exec cat\nexec cat "${last#@}"\n')
    curl.chmod(0o755)
    path = f"{tools}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-e"],
        input=code_of(out, name, "serving-rest"),
        capture_output=True,
        text=True,
        cwd=out,
        env={**os.environ, "PATH": path},
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["onnxruntime", "saved-model", "serving-grpc", "serving-rest"])
@pytest.mark.parametrize("name", NAMES)
def test_what_python_is_told_gives_what_numpy_gives(
    name: str, target: str, out: Path, answers: Callable[[str, str], dict[str, Any]]
) -> None:
    policy = load_policy(out / name, runtime="numpy")
    answer = answers(target, name)
    same(answer["outputs"], in_numpy(policy, answer["feeds"]), policy)
    if target != "serving-rest":
        steps = 3 if name == "recurrent" else 1
        assert len(re.findall(r"\[\[", answer["printed"])) == steps
        plain = policy.signature.heads[0].plain
        assert plain is not None
        np.testing.assert_allclose(answer["action"], answer["outputs"][plain.name])


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_load_policy_decides_as_in_numpy(name: str, out: Path, answers: Callable[[str, str], dict[str, Any]]) -> None:
    policy = load_policy(out / name, runtime="numpy")
    agents = policy.agent(deterministic=True)
    zeros = {s.name: np.zeros([n or 1 for n in s.shape], s.dtype) for s in policy.signature.observations}
    for _ in range(3 if name == "recurrent" else 1):
        decision = agents.decide(zeros)
    found = answers("load-policy", name)["outputs"]
    for key in ("continuous", "discrete", "memory"):
        expected = getattr(decision, key)
        assert (expected is None) == (key not in found)
        if expected is not None:
            np.testing.assert_allclose(found[key], expected, atol=1e-5, rtol=1e-5)


# ------------------------------------------------------------------ C#, Unity, shell


def balanced(code: str) -> bool:
    plain = re.sub(r"//[^\n]*", "", re.sub(r'"(\\.|[^"\\])*"', '""', code))
    stack: list[str] = []
    for letter in plain:
        if letter in "([{":
            stack.append(")]}"["([{".index(letter)])
        elif letter in ")]}" and (not stack or stack.pop() != letter):
            return False
    return not stack


@pytest.mark.parametrize("target", ["tensorflowsharp", "inference-engine"])
@pytest.mark.parametrize("name", NAMES)
def test_csharp_feeds_every_input_and_reads_the_action(name: str, target: str, out: Path) -> None:
    code, bundle = code_of(out, name, target), bundle_of(out, name)
    assert balanced(code)
    for line in (line.split("//")[0].strip() for line in code.splitlines()):
        assert re.search(r"^$|[;{})]$|^public (static )?class \w+( : MonoBehaviour)?$", line), line
    fed = 'runner.AddInput(graph["{}"][0]' if target == "tensorflowsharp" else 'worker.SetInput("{}"'
    read = 'runner.Fetch(graph["{}"][0]' if target == "tensorflowsharp" else 'worker.PeekOutput("{}"'
    for spec in bundle.signature.inputs:
        assert code.count(fed.format(spec.name)) == 1
    assert all(read.format(spec.name) in code for spec in bundle.fetched_outputs.values())
    assert not re.search(r"\$\w", code)
    if bundle.memory is not None:
        assert read.format(bundle.memory[1]) in code
        assert "memory = " in code
    if target == "tensorflowsharp" and bundle.previous is not None:
        assert "previous[0, branch] = (int)action[0, branch];" in code


def test_csharp_arrays_have_the_ranks_and_types_of_the_contract(out: Path) -> None:
    code = code_of(out, "visual", "tensorflowsharp")
    assert "new float[1, 20, 20, 3]" in code
    assert "(float[,])output[0].GetValue()" in code
    code = code_of(out, "recurrent", "tensorflowsharp")
    assert "var previous = new int[1, 2];" in code
    assert "new float[,] { { 1f, 1f, 1f, 1f, 1f } }" in code
    assert "(long[,])output[0].GetValue();" in code
    assert "(long[,])output[0].GetValue()" in code_of(out, "sampled", "tensorflowsharp")


@pytest.mark.parametrize("name", NAMES)
def test_the_container_mounts_the_model_as_its_first_version(name: str, out: Path) -> None:
    code = code_of(out, name, "serving-docker")
    assert f'source="$(pwd)"/{name}/saved_model,target=/models/{name}/1,readonly' in code
    assert f"MODEL_NAME={name} tensorflow/serving" in code
    assert subprocess.run(["sh", "-n"], input=code, text=True).returncode == 0
    absolute, _ = snippets(read_bundle(out / name), "serving-docker")
    assert f"source={(out / name).as_posix()}/saved_model," in absolute[0].code


def test_the_internal_brain_is_told_what_its_inspector_asks(out: Path) -> None:
    text = code_of(out, "continuous", "internal-brain")
    assert "ML-Agents 0.1, 0.2, 0.3-0.4, 0.5: Brain Type Internal" in text
    assert re.search(r"Vector Observation Node Name +state\n", text)
    assert re.search(r"Action Node Name +action\n", text)
    assert "epsilon: Floating Point, Min Value 0, Max Value 0" in text
    assert "Space Size 8, Stacked Vectors 1; or, as it was trained, Space Size x Stacked Vectors: 4 x 2" in text
    assert re.search(r"Graph Scope +\(empty\)", text)
    assert "Width 20, Height 20, colour" in code_of(out, "visual", "internal-brain")


def test_the_internal_brain_knows_its_generations(out: Path) -> None:
    text = code_of(out, "discrete", "internal-brain")
    assert "ML-Agents 0.5: Brain Type Internal" in text
    assert re.search(r"Action Node Name +deterministic_action\n", text)
    assert "ML-Agents 0.3-0.4: not this policy: it has one branch of discrete actions" in text
    assert "Branches Size 3: 3, 2, 4" in text
    assert "ML-Agents 0.6: not this bundle: it does not know state" in text
    assert "asks a policy with memory for memory_size and sequence_length: export with --for tfsharp-0.5" in code_of(
        out, "recurrent", "internal-brain"
    )
    assert "(export it with --for tfsharp-0.6)" in text
    scoped = code_of(out, "own-names-Goalie-Brain-2", "internal-brain")
    assert re.search("Graph Scope +Goalie-Brain-2/", scoped)
    assert re.search(r"Node Name +state\n", scoped)


@pytest.mark.parametrize("name", ["discrete", "recurrent"])
def test_what_the_internal_brain_lacks_is_there_with_the_profile_it_names(name: str, tmp_path: Path) -> None:
    for release, said in (("0.5", "ML-Agents 0.5: Brain Type Internal"), ("0.6", "ML-Agents 0.6: drop ")):
        (result,) = export_model(fixture(name), tmp_path / release, for_=f"tfsharp-{release}", verify="none")
        (told,), _ = snippets(read_bundle(result.folder), "internal-brain")
        assert said in told.code


# ------------------------------------------------------------------ the command


def test_the_command_lists_all_or_prints_one(out: Path) -> None:
    ran = run("snippets", out / "continuous")
    assert ran.status == 0
    listed = ran.out.splitlines()
    assert [line.split()[0] for line in listed[2:-1]] == [t.name for t in TARGETS]
    assert listed[-1] == f"next: export-model snippets {out / 'continuous'} --for load-policy"
    one = run("snippets", out / "continuous", "--for", "onnxruntime")
    made, _ = snippets(read_bundle(out / "continuous"), "onnxruntime")
    assert one.out == made[0].code
    group = run("snippets", out / "continuous", "--for", "serving").out
    assert group.count("====\n") == 3


def test_json_has_every_snippet(out: Path) -> None:
    content = run("snippets", out / "recurrent", "--json").json
    assert [s["name"] for s in content["snippets"]] == [t.name for t in TARGETS]
    assert content["left_out"] == {}


def test_labels_are_comments(out: Path) -> None:
    assert "# 2 continuous actions: 0 roll </script>, 1 pitch" in code_of(out, "continuous", "onnxruntime")
    page = code_of(out, "continuous", "tfjs")
    assert "1 pitch" in page
    assert page.count("</script>") == page.count("<script") == 3


@pytest.mark.corpus
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared: public models")
@pytest.mark.parametrize("kind", ["onnx", "nn", "bytes"])
def test_every_kind_of_public_policy_has_snippets(kind: str, tmp_path: Path) -> None:
    files = sorted((SHARED / "corpus" / kind).rglob(f"*.{kind}"))
    rendered = 0
    for number, file in enumerate(files[:: max(1, len(files) // 12)]):
        try:
            to = (*DEFAULTS, "csharp", "litert")
            results = list(export([file], ExportOptions(tmp_path / str(number), to, verify="none")))
        except ExportModelError:
            continue
        for result in results:
            made, lacking = snippets(read_bundle(result.folder))
            assert len(made) == len(TARGETS) and not lacking
            for snippet in made:
                if snippet.target.language == "python":
                    compile(snippet.code, snippet.target.name, "exec")
                if snippet.target.language == "csharp":
                    assert balanced(snippet.code), snippet.code
            rendered += 1
    assert rendered
