"""All snippets of a policy give its deterministic action, and say so in the same words; C#'s are run with stubs."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.runtimes.csharp import tools
from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.snippets.contract import SnippetBundle, agent_text, chance_text, read_bundle
from export_model.exporter.snippets.registry import snippets
from export_model.signatures.roles import Role
from fixtures import path as fixture
from tests.acting.snippet_bundles import NAMES
from tests.exporting import export_model, load_policy

STUBS = Path(__file__).with_name("stubs")
STEPS = 3
#: What these snippets print or return is an action.
DECIDING = (
    *("load-policy", "onnxruntime", "saved-model", "serving-rest", "serving-grpc", "litert", "policy-tfjs"),
    *("policy-node", "policy-ort", "policy-ort-node", "tfjs", "tfjs-node", "onnxruntime-web", "onnxruntime-web-node"),
    *("tensorflowsharp", "inference-engine", "source-agent", "internal-brain"),
)
#: Policy → the words of all of them, up to what draws.
WORDS = {
    "continuous": "deterministic; drawn: ",
    "discrete": "deterministic; drawn: ",
    "sampled": "deterministic; drawn: ",
    "recurrent": "deterministic; drawn: ",
}


@pytest.fixture(scope="module")
def folders(out: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """All fixtures, and files whose action is odds alone: names that a consumer fixed leave no room for another."""
    made = tmp_path_factory.mktemp("consumers")
    found = {name: out / name for name in NAMES}
    for number, profile in enumerate(("tfsharp-0.6", "barracuda-1.0")):
        (result,) = export_model(
            fixture("discrete"), made / str(number), for_=profile, verify="none", name=f"odds{number}"
        )
        found[result.folder.name] = result.folder
    return found


def steps_of(policy: LoadedPolicy) -> Iterator[tuple[dict[str, np.ndarray], dict[str, np.ndarray]]]:
    """(feeds, outputs) of each step for zeros, every action allowed, in numpy."""
    signature = policy.signature
    feeds = {s.name: np.full([n or 1 for n in s.shape], s.role is Role.MASKS, s.dtype) for s in signature.inputs}
    agents = policy.agent(deterministic=True)
    for _ in range(STEPS if signature.memory else 1):
        outputs = policy.run(feeds, [s.name for s in signature.outputs])
        yield feeds, outputs
        decision = agents.decide(
            {s.name: feeds[s.name] for s in signature.observations},
        )
        feeds = {**feeds, **{taken: outputs[given] for taken, given in signature.recurrences}}
        for spec in signature.inputs:
            if spec.role is Role.PREV_ACTION and decision.discrete is not None:
                feeds[spec.name] = decision.discrete.astype(spec.dtype)


def recorded(name: str, steps: list[tuple[dict[str, np.ndarray], dict[str, np.ndarray]]]) -> Iterator[str]:
    """C# that keeps what each step answered."""
    kinds = {"float32": "float", "int64": "long", "int32": "int"}
    for number, (_, outputs) in enumerate(steps):
        for key, value in outputs.items():
            shape, numbers = ", ".join(map(str, value.shape)), ", ".join(repr(float(x)) for x in value.ravel())
            kind = kinds[str(value.dtype)]
            made = f"typeof({kind}), new[] {{ {shape} }}, new double[] {{ {numbers} }}"
            yield f'Recorded.Add("{name}/{number}/{key}", {made});'


def run_csharp(folder: Path, target: str, codes: dict[str, str], main: list[str]) -> list[str]:
    """Compile the snippets with the target's stub, and return what the program prints."""
    mcs, mono = tools() or pytest.skip("mono is not installed: sudo apt-get install mono-mcs mono-runtime")
    for name, code in codes.items():  # C# 8's using declaration is younger than this compiler
        (folder / f"{name}.cs").write_text(code.replace("using var ", "var "))
    lines = "\n".join(f"        {line}" for line in main)
    (folder / "main.cs").write_text(
        f"using System.Linq;\nstatic class Program\n{{\n    static void Main()\n    {{\n{lines}\n    }}\n}}\n"
    )
    stubs = [str(STUBS / f"{name}.cs") for name in ("recorded", target.replace("-", "_"))]
    command = [
        mcs,
        "-langversion:7.2",
        "-main:Program",
        "-out:main.exe",
        "main.cs",
        *(f"{n}.cs" for n in codes),
        *stubs,
    ]
    subprocess.run(command, check=True, cwd=folder)
    done = subprocess.run([mono, "main.exe"], check=True, cwd=folder, capture_output=True, text=True)
    return done.stdout.splitlines()


def calling(target: str, code: str, name: str, bundle: SnippetBundle, steps: int) -> Iterator[str]:
    """C# that runs a snippet as its user would: its Main, or its Decide at each step."""
    (kind,) = re.findall(r"^public (?:static )?class (\w+)", code, re.MULTILINE)
    yield f'Recorded.Policy = "{name}"; Recorded.Step = 0;'
    if target == "tensorflowsharp":
        yield f"{kind}.Main();"
        return
    (taken,) = re.findall(r" Decide\((.*)\)", code)
    masks = {re.sub(r"\W", "_", s.name): s for s in bundle.signature.inputs}
    given = []
    for part in taken.split(", "):
        word, variable = part.split(" ")
        spec = masks[variable]
        value = "1" if spec.role is Role.MASKS else "0"
        size = int(np.prod([n or 1 for n in spec.shape]))
        given.append(f"Enumerable.Repeat<{word[:-2]}>({value}, {size}).ToArray()")
    made = f"made_{re.sub('[^A-Za-z0-9]', '_', name)}"
    yield f"var {made} = new {kind}();"
    hidden = "System.Reflection.BindingFlags.NonPublic | System.Reflection.BindingFlags.Instance"
    yield f'typeof({kind}).GetMethod("Start", {hidden}).Invoke({made}, null);'
    for _ in range(steps):
        yield f'Recorded.Print("acts", {made}.Decide({", ".join(given)})); Recorded.Step++;'


@pytest.mark.parametrize("target", ["tensorflowsharp", "inference-engine"])
def test_csharp_feeds_zeros_and_takes_the_deterministic_action(
    target: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    needed = {"tensorflowsharp": "bytes", "inference-engine": "onnx"}[target]
    codes: dict[str, str] = {}
    main: list[str] = []
    steps: dict[str, list[Any]] = {}
    policies: dict[str, LoadedPolicy] = {}
    for name, folder in folders.items():
        if not list(folder.glob(f"*.{needed}")):
            continue
        bundle = replace(read_bundle(folder), folder=folder)
        (made,), _ = snippets(bundle, target)
        codes[name] = made.code
        policies[name] = policy = load_policy(
            folder, runtime="numpy" if list(folder.glob("*.bytes")) else "onnxruntime"
        )
        steps[name] = list(steps_of(policy))
        main += [*recorded(name, steps[name]), *calling(target, made.code, name, bundle, len(steps[name]))]
    assert len(codes) == len(NAMES) + 1
    said = run_csharp(tmp_path, target, codes, main)
    for name, policy in policies.items():
        check_policy(policy, steps[name], said, name)


def check_policy(policy: LoadedPolicy, steps: list[Any], said: list[str], name: str) -> None:
    """What was fed is what numpy was fed, and the action is the one that numpy's agent takes."""
    agents = policy.agent(deterministic=True)
    expected = [agents.decide({s.name: f[s.name] for s in policy.signature.observations}).action for f, _ in steps]
    own = own_lines(said, name)
    fed: dict[str, list[np.ndarray]] = {}
    for line in own:
        if line.startswith("fed "):
            _, key, numbers = line.split(" ")
            fed.setdefault(key, []).append(np.array(numbers.split(","), float))
    assert set(fed) == {s.name for s in policy.signature.inputs}
    for number, (feeds, _) in enumerate(steps):
        for key, value in feeds.items():
            np.testing.assert_allclose(fed[key][number], value.ravel(), rtol=1e-6, atol=1e-7, err_msg=f"{name} {key}")
    printed = [float(x) for line in own if not line.startswith("fed ") for x in line.split(" ")[-1].split(",")]
    np.testing.assert_allclose(printed, np.concatenate([a.ravel() for a in expected]), rtol=1e-6, atol=1e-6)


def own_lines(said: list[str], name: str) -> list[str]:
    """The lines of one policy: from its first to the next one's first, without its name."""
    found, current = [], ""
    for line in said:
        if line.startswith("> "):
            current, line = line[2:].split(" ", 1)
        if current == name:
            found.append(line)
    return found


@pytest.mark.parametrize("name", WORDS)
def test_all_say_in_the_same_words_that_it_is_deterministic(name: str, folders: dict[str, Path]) -> None:
    made, lacking = snippets(read_bundle(folders[name]))
    assert not lacking
    codes = {s.target.name: s.code for s in made}
    assert set(codes).issuperset(DECIDING)
    for target in DECIDING:
        if target == "internal-brain" and name == "continuous":
            assert "epsilon: Floating Point, Min Value 0, Max Value 0 (deterministic" in codes[target]
            continue
        if target == "internal-brain" and "Action Node Name" not in codes[target]:
            continue
        assert codes[target].count(WORDS[name]) == 1, target
        assert not re.search(r"random|default_rng|gumbel|seed", codes[target], re.IGNORECASE), target


def test_what_is_drawn_inside_the_file_is_not_called_deterministic(tmp_path: Path) -> None:
    (result,) = export_model(fixture("sampled"), tmp_path, for_="tfsharp-0.5", verify="none")
    bundle = read_bundle(result.folder)
    assert chance_text(bundle, bundle.heads[0]) == "drawn inside the file, which has no deterministic action"
    (loading,), _ = snippets(bundle, "load-policy")
    assert "policy.agent()\n" in loading.code
    exec(compile(loading.code, "snippet", "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("continuous", "2 continuous actions, no memory"),
        ("discrete", "3 discrete actions, no memory"),
        ("recurrent", "2 discrete actions, a memory: agents.reset() where an episode begins"),
    ],
)
def test_load_policy_says_what_this_policy_has(name: str, words: str, folders: dict[str, Path]) -> None:
    bundle = read_bundle(folders[name])
    assert agent_text(bundle) == words
    for target in ("load-policy", "policy-tfjs", "policy-node"):
        (made,), _ = snippets(bundle, target)
        assert words in made.code


def test_one_action_is_not_called_actions(folders: dict[str, Path]) -> None:
    bundle = read_bundle(folders["continuous"])
    first = replace(bundle.signature.outputs[0], shape=(None, 1))
    signature = replace(bundle.signature, outputs=(first, *bundle.signature.outputs[1:]))
    made, _ = snippets(replace(bundle, signature=signature))
    assert any("1 continuous action" in s.code for s in made)
    assert not [s.target.name for s in made if re.search(r"\b1 (continuous )?actions", s.code)]
