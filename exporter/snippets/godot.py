"""An AIController of Godot RL Agents for a policy made for it (``--for godot-rl``); read, not run in Godot here.

Source: controller/ai_controller_3d.gd and sync.gd of the plugin: ``get_obs``, ``get_action_space``, ``set_action``.
"""

from __future__ import annotations

from export_model.exporter.snippets.contract import SnippetBundle, fill_template


def godot(bundle: SnippetBundle) -> str:
    """The controller, in GDScript; a line that says how to get the file where it was made for another consumer."""
    if bundle.made_for != "godot-rl":
        return f"# {bundle.name}.onnx has other names than the plugin loads: export-model SOURCE --for godot-rl\n"
    sizes = bundle.signature.branches
    width = bundle.heads[0].shape[-1]
    entry = '"{}": {{"size": {}, "action_type": "{}"}}'
    actions = [entry.format(f"branch_{i}" if i else "action", n, "discrete") for i, n in enumerate(sizes)]
    if not sizes:
        actions = [entry.format("action", width, "continuous")]
    given = 'action["action"] is ' + ("the number of the best action" if sizes else f"{width} numbers from -1 to 1")
    return fill_template(
        "godot.gd",
        name=bundle.name,
        size=str(bundle.signature.observations[0].shape[-1]),
        actions=", ".join(actions),
        given=given,
    )
