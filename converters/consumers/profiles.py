"""The list of profiles: every consumer that a policy can be made for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from export_model.converters.consumers.mlagents import version2, version3
from export_model.converters.consumers.mlagents.tensorflowsharp import Generation, dress
from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.robots.byte_array import sources
from export_model.converters.consumers.robots.naming import (
    GODOT_RL,
    ISAAC_LAB,
    PX4,
    name_for_godot_rl,
    name_for_isaac_lab,
    name_for_px4,
)
from export_model.converters.consumers.unity.consumers import editor_hint, purpose_text, releases_for
from export_model.converters.formats.registry import BARRACUDA, FROZEN_GRAPH, LITERT, ONNX
from export_model.signatures.errors import UsageError, suggestion

#: What CoreBrainInternal.cs gave as pictures until 0.4.0b.
_GREY = "0.4.0 and 0.4.0a give grey ones from 0 to 255, not to 1: use 0.4.0b for those"
_COLOURS = "0.3.0 gives colours from 0 to 255, not to 1, and 0.3.1 grey ones: use 0.3.1 for colours, 0.4.0b for grey"
_GENERATIONS = (
    (Generation("tfsharp-0.6", masks=True, branches=True, version=1), "ML-Agents 0.6 (plugin of TensorFlow 1.7)"),
    (Generation("tfsharp-0.5", masks=True, branches=True), "ML-Agents 0.5 (plugin of TensorFlow 1.7)"),
    (Generation("tfsharp-0.4", pictures=_GREY), "ML-Agents 0.4 (plugin of TensorFlow 1.7)"),
    (Generation("tfsharp-0.3", pictures=_COLOURS), "ML-Agents 0.3 (plugin of TensorFlow 1.4)"),
    (
        Generation(
            "tfsharp-0.2", vector="state", visual="observation_", previous=False, noise=True, memory_constant=False
        ),
        "ML-Agents 0.1 and 0.2 (plugin of TensorFlow 1.1 or 1.2)",
    ),
)
#: ML-Agents 0.1 to 0.6 on the TensorFlowSharp plugin: a ``.bytes`` for each generation.
TFSHARP = tuple(
    Profile(
        name=g.name,
        purpose=purpose,
        formats=(FROZEN_GRAPH.key,),
        dress=partial(dress, generation=g),
        code="internal-brain",
        noise=("lift", "keep", "zero") if g.noise else ("keep", "zero"),
    )
    for g, purpose in _GENERATIONS
)
_UNITY6 = releases_for("unity6")


def _misread_ops(importers: Sequence[str]) -> frozenset[str]:
    """``misread_ops`` of the readings, whose tables an export without such a profile has no use for."""
    from export_model.converters.consumers.unity.readings import misread_ops

    return misread_ops(importers)


#: The newest first; ``--for help`` shows them in this order.
PROFILES: tuple[Profile, ...] = (
    Profile(
        name="unity6",
        aliases=("sentis", "inference-engine"),
        purpose=purpose_text("ML-Agents 3.0 and 4.0", "unity6", "Sentis 2.1, Inference Engine 2.2 to 2.4"),
        formats=(ONNX.key,),
        # PreviousActionInputGenerator of 3.0.0 throws at the first decision (../shared/unity/r3/player.json)
        dress=partial(version3.dress, profile="unity6", feeds_previous=False),
        importers=tuple(c.runtime for c in _UNITY6),
        misread=_misread_ops,
        checkers=tuple(c.name for c in _UNITY6),
        players=tuple(c.name for c in _UNITY6),
    ),
    Profile(
        name="barracuda-3",
        aliases=("barracuda",),
        purpose=purpose_text("ML-Agents 2.3 (release 20)", "barracuda-3", "Barracuda 3.0"),
        formats=(ONNX.key, BARRACUDA.key),
        # measured in releases 20 and 2.0.1: ../shared/unity/r3/minimal/rank2.jsonl
        dress=partial(version3.dress, profile="barracuda-3", transposes_buffers=True),
        opset=12,
        importers=("Barracuda 3.0.0",),
        misread=_misread_ops,
        checkers=("R20",),
        players=("R20",),
    ),
    Profile(
        name="barracuda-1.4",
        purpose=purpose_text("ML-Agents 2.0 to 2.2 (releases 17 to 19)", "barracuda-1.4", "Barracuda 1.4 to 2.3"),
        formats=(ONNX.key, BARRACUDA.key),
        dress=partial(version3.dress, profile="barracuda-1.4", transposes_buffers=True),
        opset=12,
        importers=("Barracuda 1.4.0", "Barracuda 2.0.0", "Barracuda 2.3.1"),
        misread=_misread_ops,
        checkers=("R20",),
        players=("2.0.1",),
    ),
    Profile(
        name="barracuda-1.0",
        purpose=purpose_text("ML-Agents 1.0 to 1.9 (releases 1 to 16)", "barracuda-1.0", "Barracuda 1.0 to 1.3")
        + "; memory in .nn alone",
        formats=(ONNX.key, BARRACUDA.key),
        dress=partial(version2.dress, profile="barracuda-1.0"),
        opset=11,
        importers=("Barracuda 1.1.2", "Barracuda 1.4.0"),
        misread=_misread_ops,
        checkers=("R20",),
        players=("1.9.1", "1.0.8"),
    ),
    *TFSHARP,
    Profile(
        name=ISAAC_LAB,
        aliases=("rsl-rl",),
        purpose="robots that run rsl_rl's exports (Isaac Lab, legged_gym): obs to actions, the mean, for one robot",
        formats=(ONNX.key,),
        dress=name_for_isaac_lab,
        opset=11,
        code="onnxruntime",
        loaders=("Isaac Lab",),
        batch=1,
        noise=("zero",),
    ),
    Profile(
        name=GODOT_RL,
        aliases=("godot",),
        purpose="Godot RL Agents' plugin in Godot 4 .NET: obs and state_ins to output and state_outs, without chance",
        formats=(ONNX.key,),
        dress=name_for_godot_rl,
        opset=17,
        code="godot",
        loaders=("Godot RL Agents",),
        noise=("zero",),
    ),
    Profile(
        name=PX4,
        purpose="PX4's neural control (mc_nn_control): 15 numbers to 4 motors, .tflite and the C array of it",
        formats=(LITERT.key,),
        dress=name_for_px4,
        code="px4",
        loaders=("PX4",),
        batch=1,
        noise=("zero",),
        beside=sources,
    ),
)


def profile(name: str) -> Profile:
    """The profile of a word of ``--for``. Raises UsageError."""
    for known in PROFILES:
        if name.lower() in (known.name, *known.aliases):
            return known
    close = suggestion(name.lower(), (n for p in PROFILES for n in (p.name, *p.aliases)))
    raise UsageError(
        f"--for {name}: no such name",
        why=editor_hint(name),
        fix=f"{close}the names are {', '.join(p.name for p in PROFILES)}",
    )
