"""Which generation of ML-Agents wrote a graph, from what is in it (the constants, the names, the samplers)."""

from __future__ import annotations

from collections.abc import Collection, Mapping


def generation(constants: Mapping[str, int | float], placeholders: Collection[str], ops: Collection[str]) -> str:
    """A label such as ``"ML-Agents 0.19.0"`` or ``"ML-Agents 0.3-0.4"``; ``"own model"`` where nothing tells.

    ``placeholders`` are names without scope, ``ops`` the op types upstream of the outputs. Rules: the constants
    ``trainer_*_version`` came with 0.17, ``version_number`` with 0.6 (1) and 0.7 (2), ``action_masks`` with 0.5,
    ``vector_observation`` with 0.3; ``epsilon`` was a placeholder in 0.1-0.2 and 0.6-0.14.
    """
    parts = [constants.get(f"trainer_{p}_version") for p in ("major", "minor", "patch")]
    if all(p is not None for p in parts):
        return "ML-Agents " + ".".join(str(int(p)) for p in parts if p is not None)
    version = constants.get("version_number")
    if version == 1:
        return "ML-Agents 0.6"
    if version == 2:
        in_graph_noise = "RandomStandardNormal" in ops
        if "epsilon" in placeholders:
            return "ML-Agents 0.7-0.14"
        # PPO draws inside the graph from 0.15 on, SAC from 0.10 on; discrete graphs do not differ.
        return "ML-Agents 0.10-0.16" if in_graph_noise else "ML-Agents 0.7-0.16"
    names = set(placeholders)
    if any(n.startswith(("vector_observation", "visual_observation")) for n in names):
        return "ML-Agents 0.5" if "action_masks" in names else "ML-Agents 0.3-0.5"
    if any(n == "state" or n.startswith("observation_") for n in names):
        return "ML-Agents 0.1-0.2"
    return "own model"
