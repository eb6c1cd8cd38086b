"""Unity of today: ML-Agents 3.0 and 4.0 (releases 22 and 23) on Sentis 2.1 and the Inference Engine 2.2 to 2.4."""

from __future__ import annotations

from converters.targets.importable import importable
from converters.targets.mlagents.version3 import dress
from converters.targets.profile import Profile

PROFILE = Profile(
    name="unity6",
    aliases=("sentis", "inference-engine"),
    purpose="ML-Agents 3.0 and 4.0 in Unity 2023 and Unity 6 (Sentis 2.1, Inference Engine 2.2 to 2.4)",
    formats=("onnx",),
    dress=lambda policy: dress(policy, "unity6"),
    importers=("Sentis 2.1.3", "Inference Engine 2.2.2", "Inference Engine 2.4.0"),
    checkers=("R22", "R23", "R23-2.4"),
    check=importable,
)
