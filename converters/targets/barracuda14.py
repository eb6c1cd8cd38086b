"""ML-Agents 2.0 to 2.2 (releases 17 to 19) on Barracuda 1.4, 2.0 and 2.3."""

from __future__ import annotations

from converters.targets.importable import importable
from converters.targets.mlagents.version3 import dress
from converters.targets.profile import Profile

PROFILE = Profile(
    name="barracuda-1.4",
    purpose="ML-Agents 2.0 to 2.2 (releases 17 to 19) in Unity 2019 to 2021 (Barracuda 1.4 to 2.3)",
    formats=("onnx", "nn"),
    dress=lambda policy: dress(policy, "barracuda-1.4"),
    opset=12,
    importers=("Barracuda 1.4.0", "Barracuda 2.0.0", "Barracuda 2.3.1"),
    checkers=("R20",),
    check=importable,
)
