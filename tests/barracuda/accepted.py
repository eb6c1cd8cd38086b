"""What ML-Agents' own checker (release 20, by the rules that were measured) says to a ``.nn`` of ours."""

from __future__ import annotations

import math
from pathlib import Path

from export_model.converters.consumers.named_files import artifact_of
from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.converters.consumers.unity.settings import Brain, sensors_of
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role

_MEMORY = "Models from com.unity.ml-agents 1.x that use recurrent neural networks are not supported"


def agent_of(policy: Policy) -> Brain:
    """The Behavior Parameters and sensors of the agent that a policy was trained for."""
    signature, shapes, vector = policy.signature, [], 0
    for spec in (s for s in signature.inputs if s.role is Role.VECTOR):
        vector += math.prod(int(d or 0) for d in spec.shape[1:])
    for spec in (s for s in signature.inputs if s.role is Role.VISUAL):
        turned = signature.preprocess.get(spec.name, {}).get("layout") == "NCHW"
        a, b, c = (int(d or 0) for d in spec.shape[1:])
        shapes.append((a, b, c) if turned else (c, a, b))
    if vector:
        shapes.append((vector,))
    heads = {s.name.rpartition("/")[2]: s for s in signature.outputs}
    continuous = heads.get("continuous_actions", heads.get("action"))
    wide = 0
    if signature.action_space != "discrete" and continuous is not None:
        wide = math.prod(int(d or 0) for d in continuous.shape[1:])
    branches = signature.branches if signature.action_space != "continuous" else ()
    return Brain(wide, tuple(branches), vector, sensors=sensors_of(shapes))


def assert_accepted(policy: Policy, folder: Path) -> None:
    (data,) = artifact_of(WRITTEN["nn"], policy, WriteOptions("{}")).files.values()
    file = folder / "policy.nn"
    data.write(file)
    verdict = check_file(file, CONSUMERS["R20"], agent_of(policy))
    assert verdict.refused is None
    mode = verdict.modes["stochastic"]
    if policy.signature.memory is not None:
        # Release 17 and later take no memory of version 2; there is nothing else that they find.
        assert mode.load is not None
        assert _MEMORY in mode.load.message
        assert [f.message for f in mode.checks if _MEMORY not in f.message] == []
        return
    assert mode.accepted, [f.message for f in mode.checks]
    assert mode.fetched
