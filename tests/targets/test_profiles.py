"""Policies under the profiles of ``--for``: accepted by our checker, and the same actions under mapped names."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import onnx
import pytest

from export_model.converters.compiler.options import CompileOptions, NoiseMode
from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.profiles import PROFILES, profile
from export_model.converters.formats.barracuda.format import parse
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BATCH
from export_model.converters.policy.policy import Policy
from export_model.exporter.verify.checks.consumer import consumers
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.errors import ProfileError, UsageError
from tests import commands, known
from tests.exporting import export_model, load_policy
from tests.handmade import NodeDef, constant, dense, graph_bytes, node, placeholder, sampled_policy
from tests.targets.dressed import Pair, Plain, compiled, runner_of

pytest.importorskip("onnxruntime")
ROOT = Path(__file__).resolve().parents[2]
FIXTURES = [
    *sorted((ROOT / "fixtures").glob("*.bytes")),
    *(p for room in ("sb3", "torch_checkpoint") for p in sorted((ROOT / "fixtures" / room).glob("*.onnx"))),
]
BATCHES = (1, 3, 16)
#: The ones for Unity's importers; tests/legacy has those of TensorFlowSharp, in TensorFlow 1.4 and 1.7, and
#: tests/robots those of robots' runners, whose action is the mean.
UNITY = [p for p in PROFILES if p.importers]
MLAGENTS = [p for p in PROFILES if not p.loaders]

#: Policies that a profile cannot hold: (file, profile) → what the refusal names.
CANNOT_IN = {
    ("norms__legacy.onnx", "barracuda-1.0"): "ReduceMean",
    ("clean_c51__legacy.onnx", "barracuda-1.0"): "Add",
    ("entity_attention__legacy.onnx", "barracuda-3"): "Reshape",
    ("lidar_conv1d__dynamo.onnx", "barracuda-3"): "Conv",
    ("lidar_conv1d__dynamo.onnx", "barracuda-1.4"): "Conv",
    ("entity_attention__legacy.onnx", "barracuda-1.4"): "Reshape",
    ("autoregressive__legacy.onnx", "barracuda-1.0"): "ArgMax",
    ("autoregressive__dynamo.onnx", "barracuda-1.0"): "ArgMax",
    # an action [B, n, 1], whose elements Barracuda 1.1 gives in another order
    ("Balint-H+marathon-envs__ControllerMarathonMan-v1-no-collisions.onnx", "barracuda-1.0"): "Reshape",
    ("Balint-H+marathon-envs__Hopper-v0.onnx", "barracuda-1.0"): "Reshape",
    # a flattened image joined with a vector
    ("visual.bytes", "barracuda-1.0"): "Concat",
}


def held(path: Path, policies: Sequence[Policy], folder: Path, under: Sequence[Profile] = UNITY) -> dict[str, int]:
    """Hold each policy of a file under profiles: profile → how many it holds."""
    counts = dict.fromkeys((p.name for p in under), 0)
    for policy in policies:
        plain = Plain(policy)
        for wanted in under:
            counts[wanted.name] += is_held(path, plain, wanted, folder)
    return counts


def is_held(path: Path, plain: Plain, wanted: Profile, folder: Path) -> bool:
    """Whether a profile holds a policy, which then acts the same and is accepted; where not, it is refused by name."""
    policy, named = plain.policy, CANNOT_IN.get((path.name, wanted.name))
    memory = policy.signature.memory
    if memory is not None and wanted.name == "barracuda-1.0":
        named = "it has a memory"
    elif memory is not None and memory.output is None:
        named = "not given back"
    elif wanted.name == "barracuda-1.0" and any(s.is_sequence for s in policy.signature.inputs):
        named = "list of entities"
    if named:
        with pytest.raises(ProfileError, match=named):
            Pair.of(policy, wanted, plain)
        return False
    pair = Pair.of(policy, wanted, plain)
    for seed, rows in enumerate(BATCHES):
        assert pair.difference(rows, seed) is None, (policy.name, wanted.name, rows)
    for name, verdict in pair.verdicts(folder).items():
        # releases 1 to 16 know no deterministic inference
        modes = ["stochastic"] if wanted.name == "barracuda-1.0" else list(verdict.checked)
        said = verdict.accepted if name in wanted.players else verdict.checked
        assert all(said[mode] for mode in modes), (policy.name, name, verdict.to_dict())
    return True


#: Exported by the trainers themselves.
WITHOUT_MEMORY_OUT = ("ppo_0_21_discrete_lstm.onnx", "ppo_0_22_lstm.onnx")


@pytest.mark.parametrize("path", FIXTURES, ids=lambda p: p.stem)
def test_a_fixture_acts_the_same_and_is_accepted(path: Path, tmp_path: Path) -> None:
    for name, count in held(path, compiled(path), tmp_path).items():
        # ML-Agents 0.20 to 0.24 exported no recurrent_out; version 2 holds no memory
        lost = path.name in WITHOUT_MEMORY_OUT or (path.name, name) in CANNOT_IN
        lost = lost or (name == "barracuda-1.0" and ("lstm" in path.name or path.name == "recurrent.bytes"))
        assert (count == 0) == lost, name


@pytest.mark.corpus
@pytest.mark.slow
@pytest.mark.parametrize(("path", "turn"), known.in_turns(known.sources(), UNITY))
def test_a_known_policy_acts_the_same_and_is_accepted(
    path: Path, turn: Profile, tmp_path: Path, is_new: Callable[[str, Sequence[Policy]], bool]
) -> None:
    """Under every profile what has something new or is refused by one; the rest, which have other weights, in turn."""
    policies = known.policies_or_skip(path)
    every = is_new("profiles", policies) or any(name == path.name for name, _ in CANNOT_IN)
    held(path, policies, tmp_path, UNITY if every else [turn])


# ------------------------------------------------------------------ what is supplied


@pytest.mark.parametrize("draws", [False, True])
def test_masks_that_a_policy_lacks_are_supplied_and_applied(draws: bool, tmp_path: Path) -> None:
    """Of Stable-Baselines3, and of ML-Agents 0.1 to 0.4: a forbidden action is not given, even where it is the best."""
    path = ROOT / "fixtures" / "sb3" / "sb3_discrete.onnx"
    if draws:
        path = tmp_path / "drawing.bytes"
        path.write_bytes(graph_bytes(sampled_policy(actions=4)))
    (policy,) = compiled(path)
    assert not policy.signature.has_input("action_masks")
    pair = Pair.of(policy, profile("unity6"))
    assert any("action_masks was added" in note for note in pair.dressed.signature.notes)
    (width,) = pair.dressed.signature.branches
    rng = np.random.default_rng(0)
    feeds = {
        s.name: rng.standard_normal([width * 50, *(d or 1 for d in s.shape[1:])]).astype(np.float32)
        for s in pair.dressed.signature.observations
    }
    allowed = np.arange(width * 50) % width
    feeds["action_masks"] = np.eye(width, dtype=np.float32)[allowed]
    given = runner_of(pair.made)(feeds)
    assert given["discrete_actions"][:, 0].tolist() == allowed.tolist()
    assert given["deterministic_discrete_actions"][:, 0].tolist() == allowed.tolist()


@pytest.mark.parametrize("wanted", [p for p in MLAGENTS if p.name != "barracuda-1.0"], ids=lambda p: p.name)
def test_a_branch_of_one_action_is_held_beside_others(wanted: Profile, tmp_path: Path) -> None:
    """0.5 to 0.6 had branches; up to 0.4 such a policy is refused by the number of its branches."""
    path = tmp_path / "branches.bytes"
    draws = [
        node(name, "Multinomial", f"{name}_logits", "one", output_dtype=np.int64, seed=1, seed2=2) for name in "ab"
    ]
    heads = [n for name, size in (("a", 4), ("b", 1)) for n in dense(f"{name}_logits", "vector_observation", 3, size)]
    given = [placeholder("vector_observation"), constant("one", 1), constant("axis", 1), *heads, *draws]
    path.write_bytes(graph_bytes([*given, node("action", "ConcatV2", "a", "b", "axis")]))
    (policy,) = compiled(path)
    if wanted.name in ("tfsharp-0.2", "tfsharp-0.3", "tfsharp-0.4"):
        with pytest.raises(ProfileError, match="has 2 branches"):
            Pair.of(policy, wanted)
        return
    pair = Pair.of(policy, wanted)
    assert pair.dressed.signature.branches == (4, 1)
    assert pair.difference(3, 0) is None


def drawing(
    path: Path,
    *inputs: NodeDef,
    scores: Sequence[NodeDef],
    given: Sequence[NodeDef] = (),
    options: CompileOptions | None = None,
) -> Policy:
    """A policy that draws from the node ``scores``."""
    drawn = node("action", "Multinomial", "scores", "one", output_dtype=np.int64, seed=1, seed2=2)
    before = [placeholder("vector_observation"), *inputs, constant("one", 1)]
    path.write_bytes(graph_bytes([*before, *dense("logits", "vector_observation", 3, 4), *scores, drawn, *given]))
    (policy,) = compiled(path, options)
    return policy


@pytest.mark.parametrize("wanted", ["tfsharp-0.4", "tfsharp-0.2"])
def test_masks_that_a_generation_does_not_feed_are_a_row_for_each_agent(wanted: str, tmp_path: Path) -> None:
    """TensorFlow 1.x does not run a Select, or a Concat, of which one operand has a single row for all agents."""
    low = [
        constant("far", np.full((1, 4), -1e8, np.float32)),
        constant("none", np.zeros((1, 4), np.float32)),
        constant("axis", 1),
        node("barred", "Equal", "action_masks", "none"),
        node("zeros", "Mul", "logits", "none"),
        node("lowest", "Add", "zeros", "far"),
        node("chosen", "Select", "barred", "lowest", "logits"),
        node("joined", "ConcatV2", "chosen", "action_masks", "axis"),
        *dense("scores", "joined", 8, 4),
    ]
    policy = drawing(tmp_path / "masked.bytes", placeholder("action_masks", (None, 4)), scores=low)
    pair = Pair.of(policy, profile(wanted))
    assert pair.difference(3, 0) is None
    types = infer_types(pair.dressed.graph)
    strict = [n for n in pair.dressed.graph.nodes if n.op in ("Select", "ConcatV2")]
    assert strict and {types[r].shape[:1] for n in strict for r in n.inputs if types[r].shape} == {(BATCH,)}


def test_the_last_action_goes_with_the_memory_where_nothing_feeds_it(tmp_path: Path) -> None:
    """CoreBrainInternal.cs of 0.1 and 0.2 has no prev_action: TensorFlow would end with an unfed placeholder."""
    inputs = placeholder("prev_action", (None,), np.int32), placeholder("recurrent_in", (None, 4))
    scores = [
        constant("depth", 4),
        constant("on", 1.0),
        constant("off", 0.0),
        node("last", "OneHot", "prev_action", "depth", "on", "off", axis=-1),
        node("kept", "Add", "logits", "recurrent_in"),
        node("scores", "Add", "kept", "last"),
    ]
    path = tmp_path / "last.bytes"
    policy = drawing(path, *inputs, scores=scores, given=[node("recurrent_out", "Tanh", "scores")])
    pair = Pair.of(policy, profile("tfsharp-0.2"))
    assert {s.name: s.shape for s in pair.dressed.signature.inputs} == {"state": (None, 3), "recurrent_in": (None, 5)}
    assert any("the memory size is 5" in note for note in pair.dressed.signature.notes)
    assert pair.difference(3, 0) is None
    fed = Pair.of(policy, profile("tfsharp-0.3")).dressed.signature
    assert fed.has_input("prev_action") and fed.memory is not None and fed.memory.size == 4
    (made,) = export_model(path, tmp_path / "out", for_="tfsharp-0.2", verify="none")
    asked = commands.export_model("verify", made.folder, "--runtimes", "numpy", "--allow-unverified")
    assert asked.status == 0, asked.err


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("source", ["continuous.bytes", "sb3_zip/ppo_box.zip", "sb3_zip/sac_box.zip"])
def test_a_scene_of_the_first_releases_feeds_epsilon(source: str, deterministic: bool, tmp_path: Path) -> None:
    """Graph Placeholders, size 1: epsilon, floating point, 0 to 0 (../shared/seeds, 001 and 002): float32 [1]."""
    (made,) = export_model(
        ROOT / "fixtures" / source, tmp_path, for_="tfsharp-0.2", verify="none", deterministic=deterministic
    )
    graph = read_graph((made.folder / f"{made.policy.name}.bytes").read_bytes())
    assert [n.op for n in graph.nodes if n.name == "epsilon"] == ["Placeholder"]
    state = np.random.default_rng(0).standard_normal((3, graph["state"].dims[1] or 0)).astype(np.float32)

    def act(*epsilon: float) -> np.ndarray:
        return run_graph(graph, {"state": state, "epsilon": np.array(epsilon, np.float32)}, ["action"])["action"]

    (plain,) = compiled(ROOT / "fixtures" / source, CompileOptions(deterministic=True))
    wanted = run_graph(plain.graph, {plain.feeds["state"]: state}, [plain.fetches["action"]])
    np.testing.assert_allclose(act(0), wanted[plain.fetches["action"]], 1e-5, 1e-5)
    assert np.array_equal(act(0), act(0.5)) == deterministic
    quiet = load_policy(made.folder).decide(state, deterministic=True).continuous
    assert quiet is not None
    np.testing.assert_allclose(quiet, act(0), 1e-5, 1e-5)
    said = commands.export_model("snippets", made.folder, "--for", "internal-brain").out
    assert re.search(f"Graph Placeholders +Size {0 if deterministic else 1}", said)
    assert re.search("State Node Name +state\n", said)
    assert ("epsilon: Floating Point, Min Value 0, Max Value 0" in said) is not deterministic


@pytest.mark.parametrize("remembers", [True, False])
@pytest.mark.parametrize("deterministic", [True, False])
def test_unity6_is_never_given_a_last_action_to_feed(tmp_path: Path, remembers: bool, deterministic: bool) -> None:
    """PreviousActionInputGenerator of 3.0.0 writes int into float32: InvalidCastException (r3/player.json)."""
    inputs = [placeholder("prev_action", (None, 1), np.int32)]
    scores = [
        constant("depth", 4),
        constant("on", 1.0),
        constant("off", 0.0),
        constant("row", np.array([-1], np.int32)),
        node("numbers", "Reshape", "prev_action", "row"),
        node("last", "OneHot", "numbers", "depth", "on", "off", axis=-1),
        node("scores", "Add", "logits", "last"),
    ]
    given = []
    if remembers:
        inputs.append(placeholder("recurrent_in", (None, 4)))
        scores[-1] = node("scores", "Add", "kept", "last")
        scores.insert(-1, node("kept", "Add", "logits", "recurrent_in"))
        given.append(node("recurrent_out", "Tanh", "scores"))
    path = tmp_path / "last.bytes"
    policy = drawing(path, *inputs, scores=scores, given=given, options=CompileOptions(deterministic=deterministic))
    pair = Pair.of(policy, profile("unity6"))
    size = 5 if remembers else 1
    shapes = {s.name: s.shape for s in pair.dressed.signature.inputs}
    assert shapes == {"obs_0": (None, 3), "action_masks": (None, 4), "recurrent_in": (None, 1, size)}
    assert pair.dressed.constants["memory_size"].tolist() == [size]
    for step in range(3):
        assert pair.difference(3, step) is None
    said = "the deterministic one" if deterministic else "a drawn one"
    assert any(said in note for note in pair.dressed.signature.notes)


def test_a_last_action_of_another_width_is_refused(tmp_path: Path) -> None:
    scores = [
        node("floats", "Cast", "prev_action", DstT=np.float32),
        constant("weights", np.ones((2, 4), np.float32)),
        node("weighted", "MatMul", "floats", "weights"),
        node("scores", "Add", "logits", "weighted"),
    ]
    policy = drawing(tmp_path / "last.bytes", placeholder("prev_action", (None, 2), np.int32), scores=scores)
    with pytest.raises(ProfileError, match="last action has 2 columns and its action 1"):
        Pair.of(policy, profile("unity6"))


@pytest.mark.parametrize(
    ("wanted", "form"), [(p, f) for p in MLAGENTS for f in p.formats], ids=lambda v: getattr(v, "name", v)
)
def test_a_policy_of_a_single_action_keeps_its_inputs(wanted: Profile, form: str, tmp_path: Path) -> None:
    """Its action hangs on nothing; Unity looks for the observation and the masks all the same."""
    path = tmp_path / "single.bytes"
    head = dense("logits", "vector_observation", 3, 1)
    drawn = node("action", "Multinomial", "logits", "one", output_dtype=np.int64, seed=1, seed2=2)
    path.write_bytes(graph_bytes([placeholder("vector_observation"), constant("one", 1), *head, drawn]))
    (made,) = export_model(path, tmp_path / "out", for_=wanted.name, to=form, verify="none")
    if form != "bytes":
        files = {form: next(made.folder.glob(f"*.{form}"))}
        findings = list(consumers(wanted.name, files))
        assert findings and all(f.passed for f in findings), [f.reason for f in findings]


def test_what_unity_reads_is_float32_and_constants_are_outputs(tmp_path: Path) -> None:
    for name in ("recurrent", "visual", "sampled", "continuous"):
        (result,) = export_model(ROOT / "fixtures" / f"{name}.bytes", tmp_path, for_="sentis", verify="none")
        graph = onnx.load(next(result.folder.glob("*.onnx"))).graph
        assert {i.type.tensor_type.elem_type for i in graph.input} == {onnx.TensorProto.FLOAT}
        outputs = {o.name: o.type.tensor_type.elem_type for o in graph.output}
        assert outputs["version_number"] == outputs["memory_size"] == onnx.TensorProto.FLOAT
        made = {name for node in graph.node for name in node.output}
        assert set(outputs) <= made
        assert not any(name.endswith(":0") for node in graph.node for name in node.output)


def test_the_draws_of_a_continuous_policy_are_put_back() -> None:
    """In the model, as the trainers of PyTorch do it: with the noise lifted out again, the same action comes of it."""
    (policy,) = compiled(ROOT / "fixtures" / "continuous.bytes")
    pair = Pair.of(policy, profile("barracuda-3"))
    assert [n.op_type for n in pair.made.graph.node].count("RandomNormalLike") == 1
    assert not pair.dressed.signature.noise
    assert pair.difference(16, 0) is None


# ------------------------------------------------------------------ the command


def test_help_lists_every_profile_with_its_purpose() -> None:
    ran = commands.export_model("--for", "help")
    assert ran.status == 0
    for each in PROFILES:
        assert each.name in ran.out and each.purpose in ran.out
    assert [p["name"] for p in commands.export_model("--for", "help", "--json").json["profiles"]] == [
        p.name for p in PROFILES
    ]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"for_": "unity7"}, "did you mean unity6"),
        ({"for_": "unity6", "to": "bytes"}, "does not go with --for unity6"),
        ({"for_": "unity6", "names": "source"}, "the consumer decides the names"),
        ({"for_": "barracuda-1.0", "to": "onnx,nn"}, "export twice"),
    ],
)
def test_what_does_not_go_together_is_refused(how: dict[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=said):
        export_model(ROOT / "fixtures" / "continuous.bytes", tmp_path, verify="none", **how)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


#: A mean and a draw beside it, made inside the graph, of the sizes that PX4 takes.
DRAWN = [
    placeholder("vector_observation", (None, 15)),
    *dense("mu", "vector_observation", 15, 4),
    node("rows", "Shape", "mu", out_type=np.int32),
    node("draw", "RandomStandardNormal", "rows", dtype=np.float32),
    node("action", "Add", "mu", "draw"),
]


@pytest.mark.parametrize("mode", get_args(NoiseMode))
@pytest.mark.parametrize("named", [(p.name, form) for p in PROFILES for form in p.formats], ids="-".join)
def test_what_is_said_of_noise_is_done_or_refused(named: tuple[str, str], mode: str, tmp_path: Path) -> None:
    consumer, form = named
    source = tmp_path / "drawn.bytes"
    source.write_bytes(graph_bytes(DRAWN))
    try:
        (made,) = export_model(source, tmp_path, for_=consumer, to=form, noise=mode, verify="none")
    except UsageError as error:
        assert mode != "zero" and f"--noise {mode} does not go with --for {consumer}" in str(error)
        (made,) = export_model(source, tmp_path, for_=consumer, to=form, verify="none")
        assert mode not in _noise_of(made.policy)
    else:
        assert _noise_of(made.policy) == [mode]


def _noise_of(policy: Policy) -> list[str]:
    fed, drawn = bool(policy.signature.noise), any(n.op == "RandomStandardNormal" for n in policy.graph.nodes)
    return [mode for mode, is_so in (("lift", fed), ("keep", drawn), ("zero", not (fed or drawn))) if is_so]


def test_an_export_for_unity_is_verified_in_theruntimes(tmp_path: Path) -> None:
    (result,) = export_model(ROOT / "fixtures" / "recurrent.bytes", tmp_path, for_="unity6", verify="onnxruntime")
    assert result.passed and result.report is not None
    assert any("under its own names" in note for note in result.report.notes)


def test_a_memory_goes_to_old_barracuda_as_nn(tmp_path: Path) -> None:
    recurrent = ROOT / "fixtures" / "recurrent.bytes"
    with pytest.raises(ProfileError, match="it has a memory"):
        export_model(recurrent, tmp_path, for_="barracuda-1.0", verify="none")
    (result,) = export_model(recurrent, tmp_path, for_="barracuda-1.0", to="nn", verify="none")
    assert [p.suffix for p in result.folder.iterdir() if p.suffix != ".json"] == [".nn"]


@pytest.mark.parametrize("path", FIXTURES, ids=lambda p: p.stem)
def test_a_fixture_as_nn_of_version_3_acts_the_same_and_is_accepted(path: Path, tmp_path: Path) -> None:
    """By the layer rules of the format, fed as release 20 feeds it: memories as inputs and outputs, classes drawn."""
    for policy in compiled(path):
        if path.name in WITHOUT_MEMORY_OUT:
            with pytest.raises(ProfileError, match="not given back"):
                Pair.of(policy, profile("barracuda-3"), form="nn")
            continue
        pair = Pair.of(policy, profile("barracuda-3"), form="nn")
        for seed, rows in enumerate(BATCHES):
            assert pair.difference(rows, seed) is None, (policy.name, rows)
        (verdict,) = pair.verdicts(tmp_path).values()
        assert all(verdict.checked.values()), verdict.to_dict()


@pytest.mark.parametrize(("wanted", "version"), [("barracuda-1.0", 2), ("barracuda-1.4", 3), ("barracuda-3", 3)])
def test_a_nn_is_of_the_version_that_its_consumer_runs_and_says_whom_it_is_for(
    wanted: str, version: int, tmp_path: Path
) -> None:
    source = ROOT / "fixtures" / "recurrent.bytes"
    (result,) = export_model(source, tmp_path, for_=wanted, to="nn", verify="numpy")
    assert result.contract["tool"]["profile"] == wanted
    file = result.folder / "recurrent.nn"
    model = parse(file.read_bytes())
    assert model.number("version_number") == version
    assert json.loads(model.metadata(EMBEDDED) or "")["tool"]["profile"] == wanted
    assert bool(model.memories) == (version == 2)
    if version == 3:
        assert {i.name: i.shape for i in model.inputs}["recurrent_in"] == (-1, 1, 32, 1)
        assert {"discrete_actions", "deterministic_discrete_actions", "recurrent_out"} <= {*model.outputs}
    for options in ((), ("--source", source)):
        again = commands.export_model("verify", result.folder, "--runtimes", "numpy", *options)
        assert again.status == 0, again.out + again.err
    said = commands.export_model("snippets", result.folder, "--for", wanted)
    assert f"recurrent.nn, made for ML-Agents {'1.0' if version == 2 else '2.'}" in said.out


def test_a_nn_of_version_3_is_a_source_like_any_other(tmp_path: Path) -> None:
    """Its classes are whole numbers, its memory [agents, 1, size]; what comes of it acts as the first did."""
    first = ROOT / "fixtures" / "torch_checkpoint" / "ppo_1_1_hybrid_lstm.onnx"
    (made,) = export_model(first, tmp_path, for_="barracuda-3", to="nn", verify="none")
    (own,), (again,) = compiled(first), compiled(next(made.folder.glob("*.nn")))
    assert (again.signature.branches, again.signature.action_space) == (own.signature.branches, "hybrid")
    rng = np.random.default_rng(0)
    feeds = {s.name: rng.random([3 if d is None else d for d in s.shape]).astype(s.dtype) for s in own.signature.inputs}
    feeds["action_masks"] = np.ones_like(feeds["action_masks"])
    wanted = ["deterministic_continuous_actions", "deterministic_discrete_actions", "recurrent_out"]
    expected = run_graph(own.graph, feeds, wanted)
    taken = {s.name for s in again.signature.inputs}
    found = run_graph(again.graph, {n: a for n, a in feeds.items() if n in taken}, wanted)
    for name in wanted:
        assert found[name].dtype == expected[name].dtype
        np.testing.assert_allclose(found[name], expected[name], atol=1e-5, err_msg=name)
