"""ML-Agents 1.0 to 1.9 (releases 1 to 16) on Barracuda 0.7 to 1.3."""

from __future__ import annotations

from converters.targets.importable import importable
from converters.targets.mlagents.version2 import dress
from converters.targets.profile import Profile

PROFILE = Profile(
    name="barracuda-1.0",
    purpose="ML-Agents 1.0 to 1.9 (releases 1 to 16) in Unity 2018 to 2020 (Barracuda 1.0 to 1.3); memory in .nn alone",
    formats=("onnx", "nn"),
    own_names=frozenset({"nn"}),
    dress=lambda policy: dress(policy, "barracuda-1.0"),
    opset=11,
    importers=("Barracuda 1.1.2", "Barracuda 1.4.0"),
    checkers=("R20",),
    check=importable,
)
