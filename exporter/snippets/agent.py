"""A complete ML-Agents ``Agent`` for a policy, with what to set in its *Behavior Parameters*.

Source: the C# interface of com.unity.ml-agents 1.0 to 4.0 (CollectObservations, WriteDiscreteActionMask,
OnActionReceived, Heuristic); read, not compiled here.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

from export_model.converters.consumers.mlagents.memory import DRAWN_KEPT
from export_model.exporter.snippets.contract import (
    SnippetBundle,
    branch_lines,
    class_name,
    fill_template,
    number_names,
    wrap_items,
)
from export_model.exporter.tables import count_text
from export_model.signatures.roles import SENSOR_ORDER, Role
from export_model.signatures.spec import TensorSpec


def agent(bundle: SnippetBundle) -> str:
    """The class, and the settings as a comment above it."""
    sensors = ordered_sensors(bundle)
    vector = vector_sensor(sensors)
    received, own = _actions(bundle)
    return fill_template(
        "agent.cs",
        type=script_name(bundle.name),
        head="\n".join(_head(bundle, sensors, vector)),
        observations="" if vector is None else _observations(bundle, vector),
        masks=fill_template("agent_masks.cs") if bundle.signature.branches else "",
        received=_inside(received),
        own=_inside(own),
    )


def _inside(lines: list[str]) -> str:
    """The lines of a method."""
    return "".join(f"        {line}\n" for line in lines)


def script_name(name: str) -> str:
    """The class of the agent."""
    word = class_name(name)
    return f"Agent{word.removeprefix('Policy')}" if word.startswith("Policy") else f"{word.removesuffix('Policy')}Agent"


def ordered_sensors(bundle: SnippetBundle) -> list[TensorSpec]:
    """The observations in the order in which Unity feeds them."""
    specs = list(bundle.signature.observations)
    numbers = {s.name: int(s.name.removeprefix("obs_")) for s in specs if re.fullmatch("obs_[0-9]+", s.name)}
    if len(numbers) == len(specs):
        return sorted(specs, key=lambda s: numbers[s.name])
    return sorted(specs, key=lambda s: SENSOR_ORDER.index(s.role))


def vector_sensor(sensors: Sequence[TensorSpec]) -> TensorSpec | None:
    """The one that ``CollectObservations`` fills."""
    return next((s for s in reversed(sensors) if s.role is Role.VECTOR and len(s.shape) < 3), None)


def _head(bundle: SnippetBundle, sensors: list[TensorSpec], vector: TensorSpec | None) -> list[str]:
    signature = bundle.signature
    size = 0 if vector is None else vector.shape[-1]
    sizes = ", ".join(map(str, signature.branches))
    lines = [
        f"The policy {bundle.name} ({signature.family}, {signature.action_space} actions) as an ML-Agents agent.",
        "Behavior Parameters, on the same GameObject:",
        f"  Vector Observation: Space Size {size}, Stacked Vectors 1",
        f"  Actions: Continuous Actions {_continuous(bundle)}, Discrete Branches {len(signature.branches)}"
        + (f" of the sizes {sizes}" if sizes else ""),
        *textwrap.wrap(f"  Model: {_model(bundle)}; Behavior Type: Inference Only", 96, subsequent_indent="    "),
    ]
    others = [s for s in sensors if s is not vector]
    if others:
        lines.append("Sensor components, called so that they sort in this order (Unity feeds them by name):")
        lines += [f"  {number} {component_text(bundle, spec)}" for number, spec in enumerate(others)]
    if signature.memory is not None:
        lines.append(
            f"Its memory ({signature.memory.size} numbers) is kept by ML-Agents, and is empty at an episode's start."
        )
        lines += [line for note in signature.notes if note == DRAWN_KEPT for line in textwrap.wrap(note, 110)]
    return [f"// {line}" for line in lines]


def _model(bundle: SnippetBundle) -> str:
    if bundle.made_for is not None:
        from export_model.converters.consumers.profiles import profile

        wanted = profile(bundle.made_for)
        form = next(f for f in wanted.formats if f"{bundle.name}.{f}" in bundle.files)
        return f"{bundle.name}.{form}, made for {wanted.purpose} (--for {wanted.name})"
    if f"{bundle.name}.nn" in bundle.files:
        return f"{bundle.name}.nn (ML-Agents 0.7 to release 16)"
    return f"{bundle.name}.onnx of a bundle made with --for unity6 (export-model --for help: for older ones)"


def component_text(bundle: SnippetBundle, spec: TensorSpec) -> str:
    """Which sensor component shows an observation."""
    lengths = [n or 0 for n in spec.shape[1:]]
    if spec.role is Role.VISUAL and len(lengths) == 3:
        layout = bundle.signature.preprocess.get(spec.name, {}).get("layout", "NHWC")
        channels, height, width = lengths if layout == "NCHW" else (lengths[2], *lengths[:2])
        colours = "Grayscale" if channels == 1 else "colour" if channels == 3 else f"{channels} channels"
        return f"{spec.name}: a Camera Sensor, Width {width}, Height {height}, {colours}"
    if spec.role is Role.ENTITIES and len(lengths) == 2:
        return f"{spec.name}: a Buffer Sensor, Observation Size {lengths[1]}, Max Num Observables {lengths[0]}"
    return f"{spec.name}: a sensor of {'x'.join(map(str, lengths))} numbers (rays, a grid, as it was trained)"


def _observations(bundle: SnippetBundle, spec: TensorSpec) -> str:
    names = bundle.signature.labels.get("observations", {}).get(spec.name, [])
    size = spec.shape[-1] or 0
    lines = wrap_items(f"{size} numbers, in the order of training", number_names(names))
    return fill_template("agent_observations.cs", comments=_inside([f"// {line}" for line in lines]), size=str(size))


def _continuous(bundle: SnippetBundle) -> int:
    return next((head.shape[-1] or 0 for head in bundle.heads if head.role is Role.CONTINUOUS), 0)


def _actions(bundle: SnippetBundle) -> tuple[list[str], list[str]]:
    """What is done with received actions, and how a player's own are given."""
    count = _continuous(bundle)
    received, own = [], []
    if count:
        labels = bundle.signature.labels.get("actions", [])
        received += [f"// {line}" for line in wrap_items(count_text(count, "continuous action"), number_names(labels))]
        received.append("var continuous = actions.ContinuousActions;")
        own.append("var continuous = actionsOut.ContinuousActions;")
        own += [f"continuous[{i}] = 0f;" for i in range(min(count, 8))]
    if bundle.signature.branches:
        received += [f"// {line}" for line in branch_lines(bundle)]
        received.append("var discrete = actions.DiscreteActions;")
        own.append("var discrete = actionsOut.DiscreteActions;")
        own += [f"discrete[{i}] = 0;" for i in range(len(bundle.signature.branches))]
    return received, own
