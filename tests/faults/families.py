"""Policies of every family, from fixtures/ alone, and how each is exported; over ../shared by hand."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.consumers.profiles import PROFILES
from export_model.converters.consumers.robots.naming import GODOT_RL, ISAAC_LAB
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import FOLDER
from fixtures import path as frozen
from fixtures.trained import run_folder
from tests.fuzz.seeds import READERS
from tests.interfaces.made import mjlab
from tests.known import SHARED, sources
from tests.robots.quadrotors import quadrotor
from tests.stable_baselines3.saved_models import saved as saved_zip
from tests.torch_checkpoint.robots import checkpoint
from tests.torch_checkpoint.test_robots import SENSORS
from tests.torch_checkpoint.test_state_dicts import options as how_read
from tests.torch_checkpoint.test_state_dicts import saved as saved_state

#: Each format's runtime that costs least to start and to ask; the source's own runs beside it where it has one.
RUNTIME = {
    "onnx": "onnxruntime",
    "bytes": "tensorflow",
    "saved_model": "tensorflow",
    "tfjs": "tfjs-cpu",
    "nn": "tensorflow",
    "litert": "litert",
    "c": "c",
    "csharp": "csharp",
    "js": "node",
}


@dataclass(frozen=True)
class Member:
    """A policy of a family: where it is, how it is read and exported, and the format that faults are planted into."""

    family: str
    name: str
    source: Callable[[Path], Path]
    form: str = "onnx"
    read: ReadOptions = field(default_factory=ReadOptions)
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        said = [self.form, *(str(v) for v in self.more.values() if isinstance(v, str))]
        return f"{self.name} ({', '.join(said)})"

    @property
    def judges(self) -> tuple[str, ...]:
        """The runtimes of the format and of most sources."""
        return tuple(dict.fromkeys(("onnxruntime", RUNTIME[self.form])))

    def options(self, out: Path, *, verified: bool) -> ExportOptions:
        """Write this format alone, verified in the source's runtime and in its own."""
        return ExportOptions(
            out,
            (self.form,),
            read=self.read,
            verify=self.judges if verified else "none",
            **self.more,
        )


def _is(path: Path) -> Callable[[Path], Path]:
    return lambda _: path


def _nn(name: str) -> Callable[[Path], Path]:
    """The .nn that a frozen graph becomes, as a source."""

    def made(folder: Path) -> Path:
        (result,) = export([frozen(name)], ExportOptions(folder / "nn", ("nn",), verify="none"))
        return result.folder / f"{name}.nn"

    return made


def _layers(folder: Path) -> Path:
    """A Keras model as TensorFlow.js saves it."""
    (folder / "layers").mkdir()
    for name, data in READERS["layers model"].seeds()[0].items():
        (folder / "layers" / name).write_bytes(data)
    return folder / "layers" / "model.json"


def _onnx(name: str) -> Callable[[Path], Path]:
    return _is(FOLDER / f"{name}.onnx")


def members() -> Iterator[Member]:
    """Policies of every family, a few each."""
    for name in ("continuous", "discrete", "recurrent", "sampled", "visual"):
        yield Member("frozen graphs, 0.3 to 0.22", name, _is(frozen(name)))
    yield Member("frozen graphs, 0.3 to 0.22", "sampled", _is(frozen("sampled")), "tfjs")
    yield Member(".nn", "continuous.nn", _nn("continuous"))
    yield Member(".nn", "discrete", _is(frozen("discrete")), "nn")
    for name in ("ppo_1_1_discrete", "ppo_1_1_hybrid_lstm", "ppo_0_22_lstm", "sac_1_1", "poca_0_26_discrete"):
        yield Member("ML-Agents PyTorch", name, _onnx(f"torch_checkpoint/{name}"))
    yield Member("ML-Agents PyTorch", "ppo_0_24_hybrid.pt", _is(FOLDER / "torch_checkpoint/ppo_0_24_hybrid.pt"))
    for name in ("3DBall", "Hallway", "GridWorld"):
        yield Member("trained Unity files", name, _is(run_folder(name) / "frozen_graph_def.pb"))
    for name in ("sb3_continuous", "sb3_discrete", "sb3_stochastic"):
        yield Member("SB3 and maskable", name, _onnx(f"sb3/{name}"))
    for name in ("maskable", "ppo_box", "recurrent_discrete", "qrdqn_box"):
        yield Member("SB3 and maskable", name, lambda folder, n=name: saved_zip(n, folder))  # type: ignore[misc]
    for family, names in (
        ("rsl_rl", ("rsl_5_5", "rsl_3_1_lstm")),
        ("CleanRL", ("clean_ppo", "clean_c51", "clean_sac", "clean_dqn")),
    ):
        for name in names:
            yield Member(family, name, lambda folder, n=name: saved_state(folder, n), read=how_read(name))  # type: ignore[misc]
    for family, names in (
        ("rl_games", ("rl_games_masked", "rl_games_lstm", "rl_games_branches")),
        ("skrl", ("skrl_ppo", "skrl_sac")),
        ("robots", ("sample_factory_gru", "rllib_branches", "sbx_ppo_branches")),
    ):
        for name in names:
            how = ReadOptions(sensors=SENSORS.get(name, ()))
            yield Member(family, name, lambda folder, n=name: checkpoint(folder, n), read=how)  # type: ignore[misc]
    for name in ("mlp_script", "isaac_lstm_script", "chosen_trace"):
        yield Member("TorchScript", name, _is(FOLDER / f"torchscript/{name}.pt"))
    yield Member("Keras", "layers model", _layers)
    yield from _written()


def _written() -> Iterator[Member]:
    """What is written otherwise: source code, LiteRT, rounded weights, profiles, interfaces."""
    for form in ("c", "js", "csharp"):
        for name in ("continuous", "recurrent", "sampled"):
            yield Member("source code", name, _is(frozen(name)), form)
    for name in ("continuous", "discrete", "recurrent"):
        yield Member("LiteRT", name, _is(frozen(name)), "litert")
    yield Member("int8, float16", "continuous", _is(frozen("continuous")), more={"weights": "int8"})
    yield Member("int8, float16", "discrete", _is(frozen("discrete")), more={"weights": "float16"})
    for name in ("ppo_1_1_discrete", "ppo_1_1_hybrid_lstm", "ppo_1_1"):
        for profile in ("unity6", "barracuda-3"):
            yield Member("profiles", name, _onnx(f"torch_checkpoint/{name}"), more={"profile": profile})
    yield Member("profiles", "continuous", _is(frozen("continuous")), more={"compile": CompileOptions(noise="keep")})
    yield Member("profiles", "quadrotor, px4", quadrotor, more={"profile": "px4"})
    isaac = {"read": how_read("rsl_5_5"), "more": {"profile": "isaac-lab"}}
    yield Member("profiles", "rsl_5_5", lambda folder: saved_state(folder, "rsl_5_5"), **isaac)  # type: ignore[arg-type]
    yield Member("interfaces", "mjlab", lambda folder: mjlab(folder, next(iter(_tasks()))))
    yield Member(
        "interfaces", "mjlab, baked", lambda folder: mjlab(folder, next(iter(_tasks()))), more={"bake": "actions"}
    )


def _tasks() -> Mapping[str, Any]:
    found: Mapping[str, Any] = json.loads((Path(__file__).parents[1] / "interfaces/files/mjlab-1.6.0.json").read_text())
    return found


#: What the first part of a name in ../shared/foreign says.
_TRAINERS = {
    "mla": "ML-Agents PyTorch",
    "sb3": "SB3 and maskable",
    "rsl": "rsl_rl",
    "clean": "CleanRL",
    "skrl": "skrl",
    "rlgames": "rl_games",
    "rl": "rl_games",
    "keras": "Keras",
}


_ROBOTS = (ISAAC_LAB, GODOT_RL)
#: Ways to write a policy of ../shared: the family that it counts for (None: the source's own), format, options.
WRITINGS: tuple[tuple[str | None, str, Mapping[str, Any]], ...] = (
    *((None, form, {}) for form in ("onnx", "bytes", "saved_model", "tfjs", "onnx", "bytes", "tfjs", "onnx")),
    (".nn", "nn", {}),
    *(("LiteRT", "litert", {}) for _ in range(2)),
    *(("source code", form, {}) for form in ("c", "js", "csharp")),
    ("int8, float16", "onnx", {"weights": "int8"}),
    ("int8, float16", "tfjs", {"weights": "float16"}),
    *(("profiles", form, {"profile": p.name}) for p in PROFILES for form in p.formats if p.name not in _ROBOTS),
    *(("profiles", form, {"compile": CompileOptions(noise="keep")}) for form in ("onnx", "bytes", "tfjs", "litert")),
)


def shared(seed: int = 0) -> Iterator[Member]:
    """The policies of ../shared, each written in one of the ways, by chance; those for robots for their loaders too."""
    rng = random.Random(seed)
    others = [p for p in sorted((SHARED / "corpus4").glob("*")) if p.suffix != ".jsonl"]
    for file in [*sources(), *others]:
        room = file.relative_to(SHARED).parts[0]
        family = _TRAINERS.get(file.name.split("_")[0], "robots")
        if file.suffix == ".nn":
            family = ".nn"
        elif file.suffix in (".bytes", ".pb"):
            family = "frozen graphs, 0.3 to 0.22" if room == "genuine" else "trained Unity files"
        elif room == "corpus":
            family = "trained Unity files"
        name = "/".join(file.relative_to(SHARED).parts[1:])[-60:]
        written, form, more = rng.choice(WRITINGS)
        yield Member(written or family, name, _is(file), form, more=more)
        if family in ("rsl_rl", "robots"):
            yield Member("profiles", name, _is(file), more={"profile": rng.choice(_ROBOTS)})
