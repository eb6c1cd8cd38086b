"""Which generation of ML-Agents wrote a graph, from what is in it (the constants, the names, the samplers)."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from export_model.signatures.roles import VERSION_NUMBER

#: What ``version_number`` says from release 17 (0.26.0) on.
TORCH_VERSION_3 = 3

#: TanhGaussianDistInstance (torch_entities/distributions.py) has no ``deterministic_sample`` of its own, 0.28 to 1.1.
SAC_MEAN = (
    "deterministic_continuous_actions is the raw mean of SAC, neither squashed by tanh nor clipped (so ML-Agents 0.28 "
    "to 1.1 give it); it is exported as it is"
)


def generation(constants: Mapping[str, int | float], placeholders: Collection[str], ops: Collection[str]) -> str:
    """A label such as ``"ML-Agents 0.19.0"`` or ``"ML-Agents 0.3-0.4"``; ``"own model"`` where nothing tells.

    ``placeholders`` are names without scope, ``ops`` the op types upstream of the outputs. Rules: the constants
    ``trainer_*_version`` came with 0.17, ``version_number`` with 0.6 (1) and 0.7 (2), ``action_masks`` with 0.5,
    ``vector_observation`` with 0.3; ``epsilon`` was a placeholder in 0.1-0.2 and 0.6-0.14.
    """
    parts = [constants.get(f"trainer_{p}_version") for p in ("major", "minor", "patch")]
    if all(p is not None for p in parts):
        return "ML-Agents " + ".".join(str(int(p)) for p in parts if p is not None)
    version = constants.get(VERSION_NUMBER)
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


def torch_generation(version: int, inputs: Collection[str], outputs: Collection[str]) -> str:
    """The versions of ML-Agents whose PyTorch exporter writes such inputs and outputs (its model_serialization.py).

    0.20 to 0.22 have ``action`` alone; from 0.23 on actions are named by kind; 0.24 added ``obs_i`` for sensors of
    rank 2; 0.25 renamed ``memories`` to ``recurrent_in`` and gave ``recurrent_out``; 0.26 (version 3) has ``obs_i``
    for every sensor; 0.28 added the deterministic outputs.
    """
    names = set(outputs)
    if version >= TORCH_VERSION_3:
        span = "0.28-1.1" if any(n.startswith("deterministic_") for n in names) else "0.26-0.27"
    elif not names & {"continuous_actions", "discrete_actions"}:
        span = "0.20-0.22"
    elif "recurrent_in" in inputs or "recurrent_out" in names:
        span = "0.25"
    elif "memories" in inputs:
        span = "0.23-0.24"
    else:
        span = "0.24-0.25" if any(n.startswith("obs_") for n in inputs) else "0.23-0.25"
    return f"ML-Agents {span} (PyTorch)"
