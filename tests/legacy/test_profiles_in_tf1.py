"""``.bytes`` of the tfsharp profiles in TensorFlow 1.4 and 1.7, fed as the C# side of that generation feeds them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.profiles import TFSHARP
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.tensorflow import RELEASES
from export_model.signatures.errors import ProfileError
from fixtures import FIXTURES
from fixtures import path as fixture
from tests import known
from tests.legacy.installed import ensure
from tests.targets.dressed import Pair, compiled

pytestmark = [pytest.mark.legacy, pytest.mark.slow]
#: Generation → the TensorFlow of its plugin. That of 0.1 and 0.2 had 1.1 or 1.2, which are not here.
TENSORFLOW = {"0.2": "tf1.4", "0.3": "tf1.4", "0.4": "tf1.7", "0.5": "tf1.7", "0.6": "tf1.7"}
#: File → (atol, why): float32 rounding that a policy makes larger, measured against the same graph in float64.
_SUMS = (
    "partial sums of up to {} in the dense layers: TensorFlow 1.x adds term by term in float32 (bit for bit what a "
    "loop gives), {} off their float64 value, our kernel {}; of the action, TensorFlow is {} off it and numpy {}"
)
ATOL = {
    "Unity-Technologies+marathon-envs__TerrainAntBrain-v0-100m-29d47f.nn": (
        5e-5,
        _SUMS.format(880, "1.1e-4", "3.4e-5", "2.3e-5", "4e-6"),
    ),
    "AliBharwani+ml-agents__Hallway.nn": (5e-5, _SUMS.format(370, "1.1e-4", "1.4e-5", "1.9e-5", "6e-6")),
}


@pytest.fixture(scope="session")
def pool(processes: RuntimePool) -> RuntimePool:
    return processes


def runtime_of(wanted: Profile) -> str:
    name = TENSORFLOW[wanted.name.removeprefix("tfsharp-")]
    return ensure(next(r for r in RELEASES if r.runtime == name))


def held(path: Path, policies: Sequence[Policy], wanted: Profile, pool: RuntimePool, folder: Path) -> int:
    """Run each policy of a file as the generation does; returns how many are held."""
    runtime, count = runtime_of(wanted), 0
    atol, _ = ATOL.get(path.name, (1e-5, ""))
    for policy in policies:
        try:
            pair = Pair.of(policy, wanted)
        except ProfileError as error:
            assert any(word in error.what for word in ("branches", "not given back", "entities", "discrete actions"))
            continue
        file = folder / f"{count}.bytes"
        file.write_bytes(pair.data)
        model = pool.process(runtime).load(str(file))
        for seed, rows in enumerate((1, 3, 16)):
            assert pair.difference(rows, seed, model.run, atol) is None, (policy.name, rows)
        model.unload()
        count += 1
    return count


@pytest.mark.parametrize("wanted", TFSHARP, ids=lambda p: p.name)
@pytest.mark.parametrize("name", FIXTURES)
def test_a_fixture_acts_the_same(name: str, wanted: Profile, pool: RuntimePool, tmp_path: Path) -> None:
    assert held(fixture(name), compiled(fixture(name)), wanted, pool, tmp_path) > 0 or name in (
        "discrete",
        "recurrent",
        "sampled",
    )


FILES = [p for p in known.sources() if p.suffix != ".keras"]


@pytest.mark.corpus
@pytest.mark.parametrize(("path", "wanted"), known.in_turns(FILES, TFSHARP))
def test_a_known_policy_acts_the_same(
    path: Path,
    wanted: Profile,
    pool: RuntimePool,
    tmp_path: Path,
    is_new: Callable[[str, Sequence[Policy]], bool],
) -> None:
    policies = known.policies_or_skip(path)
    if not is_new(wanted.name, policies):
        pytest.skip(f"has nothing that another policy of {wanted.name} has not; EXPORT_MODEL_TEST_FULL=1 runs it")
    held(path, policies, wanted, pool, tmp_path)


def test_the_constants_of_0_6_are_int32_nodes(tmp_path: Path) -> None:
    (policy,) = compiled(fixture("discrete"))
    pair = Pair.of(policy, next(p for p in TFSHARP if p.name == "tfsharp-0.6"))
    graph = read_graph(pair.data)
    values = {n.name: n.value for n in graph.nodes if n.op == "Const"}
    found = {k: int(values[k]) for k in ("version_number", "memory_size", "is_continuous_control")}
    assert found == {"version_number": 1, "memory_size": 0, "is_continuous_control": 0}
    assert int(values["action_output_shape"]) == sum(policy.signature.branches)
    assert {values[k].dtype.name for k in found} == {"int32"}
    taken = {n.name for n in graph.nodes if n.op == "Placeholder"}
    assert taken == {"vector_observation", "action_masks"}
