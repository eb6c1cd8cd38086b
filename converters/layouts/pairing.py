"""Which joint is the mirror image of which, and whether it changes its sign: by names, held against geometry.

A joint's place is mirrored in the plane y = 0. An axis that a joint turns about is mirrored as rotations are: y keeps
its sign, x and z change theirs; one that it slides along is mirrored as places are. Where names and geometry do not
say the same, nothing is said.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from export_model.converters.layouts.robot_xml import PlacedJoint
from export_model.signatures.errors import UsageError

_PLACES, _TURNS = np.array([1, -1, 1]), np.array([-1, 1, -1])
#: How far images may be apart, of the robot's size, and the smallest cosine between their axes.
_NEAR, _ALONG = 0.04, 0.97
#: A side in a name: the word, or one letter of a token of one or two (FL, rr, l).
_WORD = re.compile("left|right", re.IGNORECASE)
_TOKEN = re.compile(r"(?<![A-Za-z])[A-Za-z]{1,2}(?![a-z])")
_OTHER = {"l": "r", "r": "l", "L": "R", "R": "L"}


def mirror_pairs(joints: Sequence[PlacedJoint], where: str) -> Mapping[str, tuple[str, int]]:
    """Joint → its mirror image and its sign. Raises UsageError that lists what is unclear."""
    named = {joint.name: joint for joint in joints}
    places = np.array([joint.place for joint in joints])
    near = _NEAR * max(float(np.ptp(places, axis=0).max()), 1e-3)
    pairs: dict[str, tuple[str, int]] = {}
    unclear = []
    for joint in joints:
        others = [named[name] for name in dict.fromkeys(_other_names(joint.name)) if name in named]
        able = [(other, sign) for other in others or [joint] if (sign := _sign(joint, other, near))]
        if len(able) == 1:
            pairs[joint.name] = able[0][0].name, able[0][1]
        else:
            unclear.append(f"{joint.name}: {_reason(joint, others, len(able), near)}")
    unclear += [f"{a}: its image {b} has another" for a, (b, _) in pairs.items() if b in pairs and pairs[b][0] != a]
    if unclear:
        raise UsageError(
            f"{where}: which joint is the mirror image of which is unclear of {len(unclear)} of {len(joints)}",
            why="; ".join(unclear[:6]) + ("; …" if len(unclear) > 6 else ""),
            fix="state it: joints, pairs and turned as YAML, --robot FILE.yaml",
        )
    return pairs


def _other_names(name: str) -> Iterator[str]:
    """What a joint of the other side may be called."""
    for match in _WORD.finditer(name):
        word = match[0]
        other = "right" if word.lower() == "left" else "left"
        other = other.upper() if word.isupper() else other.capitalize() if word[0].isupper() else other
        yield name[: match.start()] + other + name[match.end() :]
    for match in _TOKEN.finditer(name):
        for i in range(match.start(), match.end()):
            if name[i] in _OTHER:
                yield name[:i] + _OTHER[name[i]] + name[i + 1 :]


def _sign(joint: PlacedJoint, other: PlacedJoint, near: float) -> int:
    """1 or -1 where ``other`` is the image of a joint; 0 where it is not."""
    if joint.slides != other.slides or _apart(joint, other) > near:
        return 0
    along = float((_PLACES if joint.slides else _TURNS) * joint.axis @ other.axis)
    return 0 if abs(along) < _ALONG else 1 if along > 0 else -1


def _apart(joint: PlacedJoint, other: PlacedJoint) -> float:
    return float(np.linalg.norm(_PLACES * joint.place - other.place))


def _reason(joint: PlacedJoint, others: Sequence[PlacedJoint], able: int, near: float) -> str:
    if able > 1:
        return f"{able} joints may be its image"
    if not others:
        beside = "is beside the middle" if _apart(joint, joint) > near else "has an axis that no mirror keeps"
        return f"no name says a side, and it {beside}"
    far = _apart(joint, others[0])
    what = f"is {far:.3g} from its image" if far > near else "has another axis than its image"
    return f"{others[0].name} {what}"
