"""Recorders: what writes the log that ``export-model verify --log`` reads, where the agent acts.

Sources: Gymnasium 1.4 (``Wrapper``), rclpy of ROS 2 Jazzy (``Node.create_subscription``), the ``play.py`` scripts of
Isaac Lab 2.3 (observations and ``dones`` are tensors, a row for each environment), and com.unity.ml-agents 1.0 to 4.0
(``Agent.GetObservations``, ``ActionBuffers``, ``CompletedEpisodes``). Gymnasium's is run here, the others with stubs.
"""

from __future__ import annotations

from collections.abc import Sequence

from export_model.exporter.snippets.agent import component_text, ordered_sensors, script_name, vector_sensor
from export_model.exporter.snippets.contract import SnippetBundle, fill_template, string_literal
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec


def gymnasium(bundle: SnippetBundle) -> str:
    """A wrapper of the environment."""
    masks = next((string_literal(s.name) for s in bundle.signature.inputs if s.role is Role.MASKS), "None")
    return fill_template("recorder_gymnasium.py", **_names(bundle), masks=masks, head=_head(bundle, "#", "run.npz"))


def ros2(bundle: SnippetBundle) -> str:
    """A node that listens to the controller's topics."""
    kinds = ["Float32MultiArray" if h.is_continuous else "Int32MultiArray" for h in bundle.signature.heads]
    entries = [f"{string_literal(h.name)}: {kind}" for h, kind in zip(bundle.heads, kinds, strict=True)]
    return fill_template(
        "recorder_ros2.py",
        observations=_names(bundle)["observations"],
        messages=f"{{{', '.join(entries)}}}",
        head=_head(bundle, "#", "run.npz"),
    )


def isaac_lab(bundle: SnippetBundle) -> str:
    """What the loop of a play script calls."""
    return fill_template("recorder_isaac_lab.py", **_names(bundle), head=_head(bundle, "#", "run.npz"))


def unity(bundle: SnippetBundle) -> str:
    """A component beside the agent."""
    sensors = ordered_sensors(bundle)
    vector = vector_sensor(sensors)
    columns = [] if vector is None else [f"row[{string_literal(vector.name)}] = Numbers(agent.GetObservations());"]
    for head in bundle.signature.heads:
        kind = "ContinuousActions" if head.is_continuous else "DiscreteActions"
        numbers = f"actions.{kind}" if head.is_continuous else f"actions.{kind}.Select(x => (float)x)"
        columns.append(f"row[{string_literal(head.name)}] = Numbers({numbers});")
    masks = next((s for s in bundle.signature.inputs if s.role is Role.MASKS), None)
    if masks is not None:
        columns.append(f"row[{string_literal(masks.name)}] = Numbers(allowed);")
        columns.append("for (var i = 0; i < allowed.Length; i++) allowed[i] = 1f;")
    lines = [_head(bundle, "//", "run.jsonl"), "// On the agent's GameObject. Sensors, in the order of their names:"]
    for number, spec in enumerate(sensors):
        own = "CollectObservations, recorded by itself" if spec is vector else component_text(bundle, spec)
        lines.append(f"//   {number} {spec.name}: {own}" if spec is vector else f"//   {number} {own}: Give it")
    return fill_template(
        "recorder_unity.cs",
        type=f"{script_name(bundle.name)}Recorder",
        head="\n".join(lines),
        masks="" if masks is None else _forbid(bundle.signature.branches),
        columns="".join(f"        {line}\n" for line in columns),
    )


def _forbid(sizes: Sequence[int]) -> str:
    firsts = ", ".join(str(sum(sizes[:i])) for i in range(len(sizes)))
    return (
        f"    readonly int[] first = {{ {firsts} }};\n"
        f"    readonly float[] allowed = Enumerable.Repeat(1f, {sum(sizes)}).ToArray();\n\n"
        "    // Beside each SetActionEnabled(branch, action, false) of WriteDiscreteActionMask.\n"
        "    public void Forbid(int branch, int action)\n    {\n        allowed[first[branch] + action] = 0f;\n    }\n"
    )


def _names(bundle: SnippetBundle) -> dict[str, str]:
    return {"observations": _tuple(bundle.signature.observations), "actions": _tuple(bundle.heads)}


def _tuple(specs: Sequence[TensorSpec]) -> str:
    return f"({''.join(f'{string_literal(s.name)}, ' for s in specs).rstrip(' ' if len(specs) == 1 else ', ')})"


def _head(bundle: SnippetBundle, mark: str, file: str) -> str:
    command = f"export-model verify {bundle.folder.as_posix()!r} --log {file}"
    text = "".join(c if c.isprintable() else "?" for c in command)
    return f"{mark} Records what the policy is given and answers. Then: {text}"
