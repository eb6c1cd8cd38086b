"""ML-Agents 0.1 to 0.6 on the TensorFlowSharp plugin: a ``.bytes`` for each generation."""

from __future__ import annotations

from functools import partial

from converters.targets.mlagents.tensorflowsharp import Generation, dress
from converters.targets.profile import Profile

#: What CoreBrainInternal.cs gave as pictures until 0.4.0b.
_GREY = "0.4.0 and 0.4.0a give grey ones from 0 to 255, not to 1: use 0.4.0b for those"
_COLOURS = "0.3.0 gives colours from 0 to 255, not to 1, and 0.3.1 grey ones: use 0.3.1 for colours, 0.4.0b for grey"
_GENERATIONS = (
    (Generation("tfsharp-0.6", masks=True, branches=True, version=1), "ML-Agents 0.6 (plugin of TensorFlow 1.7)"),
    (Generation("tfsharp-0.5", masks=True, branches=True), "ML-Agents 0.5 (plugin of TensorFlow 1.7)"),
    (Generation("tfsharp-0.4", pictures=_GREY), "ML-Agents 0.4 (plugin of TensorFlow 1.7)"),
    (Generation("tfsharp-0.3", pictures=_COLOURS), "ML-Agents 0.3 (plugin of TensorFlow 1.4)"),
    (
        Generation("tfsharp-0.2", vector="state", visual="observation_", previous=False, memory_constant=False),
        "ML-Agents 0.1 and 0.2 (plugin of TensorFlow 1.1 or 1.2)",
    ),
)
PROFILES = tuple(
    Profile(name=g.name, purpose=purpose, formats=("bytes",), dress=partial(dress, generation=g))
    for g, purpose in _GENERATIONS
)
