"""ML-Agents 2.3 (release 20) on Barracuda 3.0."""

from __future__ import annotations

from converters.targets.importable import importable
from converters.targets.mlagents.version3 import dress
from converters.targets.profile import Profile

PROFILE = Profile(
    name="barracuda-3",
    aliases=("barracuda",),
    purpose="ML-Agents 2.3 (release 20) in Unity 2020 to 2022 (Barracuda 3.0)",
    formats=("onnx", "nn"),
    dress=lambda policy: dress(policy, "barracuda-3"),
    opset=12,
    importers=("Barracuda 3.0.0",),
    checkers=("R20",),
    check=importable,
)
