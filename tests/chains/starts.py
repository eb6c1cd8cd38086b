"""Where chains begin: policies of this repository in every form that is read, and genuine ones where there are any."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import fixtures
from export_model.signatures.roles import Role
from tests.barracuda.conftest import BROKEN
from tests.barracuda.nn_files import write_nn
from tests.barracuda.test_graph import two_lstms
from tests.checkpoint.writing import bundle
from tests.checkpoint.writing import policy as training_graph
from tests.corpus.conftest import SHARED
from tests.handmade import constant, continuous_policy, graph_bytes, node, placeholder, sampled_policy
from tests.onnx_reader.mlagents import policy as torch_policy

#: Genuine and public files above this size make a chain slow and show nothing that smaller ones do not.
_SMALL = 400_000


@dataclass(frozen=True)
class Start:
    """A source: ``make`` puts it into a folder and says where it is; the rest is what the user has to say of it."""

    name: str
    make: Callable[[Path], Path]
    inputs: Mapping[str, Role] = field(default_factory=dict)
    outputs: Mapping[str, Role] = field(default_factory=dict)

    def __repr__(self) -> str:
        return self.name


def _there(path: Path) -> Callable[[Path], Path]:
    return lambda folder: path


def _bytes(name: str, data: Callable[[], bytes]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(data())
        return path

    return make


def _checkpoint(folder: Path) -> Path:
    graph = training_graph(3)
    bundle(folder / "model-30.cptk", graph.variables)
    graph.write(folder / "raw_graph_def.pb")
    return folder / "model-30.cptk"


def _with_another_output() -> bytes:
    """A policy with an output of its own, that only ``--output`` can name."""
    nodes = [*continuous_policy(), node("sensed/contact", "Sigmoid", "mu")]
    return graph_bytes(nodes)


def _by_integers(depth: int) -> bytes:
    """An observation that is a class, as ML-Agents 0.1 to 0.4 had them; a depth of 1 stands in a public policy."""
    return graph_bytes(
        [
            placeholder("state", (None, 1), np.int32),
            constant("depth", depth),
            *(constant("on", 1.0), constant("off", 0.0), constant("flat/shape", np.array([-1, depth], np.int32))),
            node("hot", "OneHot", "state", "depth", "on", "off", axis=-1),
            node("flat", "Reshape", "hot", "flat/shape"),
            constant("kernel", np.linspace(-1, 1, 3 * depth, dtype=np.float32).reshape(depth, 3)),
            node("logits", "MatMul", "flat", "kernel", transpose_a=False, transpose_b=False),
            constant("one", 1),
            node("draw", "Multinomial", "logits", "one", output_dtype=np.int64, seed=1, seed2=2),
            node("action", "Identity", "draw"),
        ]
    )


def _with_a_parameter() -> bytes:
    """A placeholder that ML-Agents does not know, and a note on it."""
    nodes = continuous_policy()[:-1]
    return graph_bytes([*nodes, placeholder("gain", (None, 2)), node("action", "Mul", "mu", "gain")])


def _torch(name: str, version: str, **form: object) -> Start:
    return Start(name, _bytes(f"{name}.onnx", lambda: bytes(torch_policy(version, **form).SerializeToString())))


def _own() -> list[Start]:
    """Policies of the repository itself."""
    sb3 = fixtures.FOLDER / "sb3"
    other = {"action": Role.ACTION, "sensed/contact": Role.OTHER}
    return [
        *(Start(name, _there(fixtures.path(name))) for name in fixtures.FIXTURES),
        *(Start(p.stem, _there(p)) for p in sorted(sb3.glob("*.onnx"))),
        Start("nn-two-lstms", _bytes("two.nn", lambda: write_nn(two_lstms()))),
        Start("checkpoint", _checkpoint),
        Start("another-output", _bytes("other.bytes", _with_another_output), outputs=other),
        Start("class-of-one", _bytes("one.bytes", lambda: _by_integers(1))),
        Start("class-of-four", _bytes("four.bytes", lambda: _by_integers(4))),
        Start("parameter", _bytes("gain.bytes", _with_a_parameter)),
        Start("single-action", _bytes("single.bytes", lambda: graph_bytes(sampled_policy(actions=1)))),
        Start("scoped", _bytes("scoped.bytes", lambda: graph_bytes(sampled_policy("GoalieBrain/")))),
        _torch("torch-hybrid", "0.28", continuous=True, branches=[3, 2]),
        _torch("torch-branches", "0.28", branches=[3, 2], identities=True),
        _torch("torch-recurrent-hybrid", "0.26", continuous=True, branches=[3, 2], recurrent=True),
        _torch("torch-recurrent", "0.23", continuous=True, recurrent=True),
        _torch("torch-sac", "0.28", continuous=True, sac=True),
    ]


def _genuine() -> list[Start]:
    """Small files of ../shared, where it exists; one that is refused is a matter of the corpus tests."""
    found = [
        *SHARED.glob("genuine/*/frozen_graph_def.pb"),
        *SHARED.glob("genuine/*/*.nn"),
        *SHARED.glob("genuine/*/*.onnx"),
        *SHARED.glob("genuine/*/*.bytes"),
        *SHARED.glob("corpus/bytes/*.bytes"),
        *SHARED.glob("corpus/nn/*.nn"),
        *SHARED.glob("corpus/onnx/*.onnx"),
    ]
    small = [p for p in sorted(found) if p.stat().st_size < _SMALL and BROKEN not in (p.name, p.parent.name)]
    return [Start(f"{p.parent.name}/{p.name}", _there(p)) for p in small]


OWN = _own()
GENUINE = _genuine()
