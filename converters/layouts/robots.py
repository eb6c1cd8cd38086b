"""Known robots: their joints as a tree, which joint is the mirror image of which, and the sign that it takes.

A joint about a lateral axis (pitch, knee) keeps its sign where left and right are exchanged, one about another axis
(roll, yaw) changes it; ``turned`` names the latter. A row's joints stand in the order of its model file, which is that
of MuJoCo and of Isaac Gym (depth first); Isaac Sim numbers joints level by level (breadth first).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec import Struct, field

DEPTH, BREADTH = "as in its model file", "level by level (Isaac Sim)"


class Chain(Struct, frozen=True):
    """Joints one below the other; ``below`` is the joint that the first hangs from, "" for the base."""

    joints: tuple[str, ...]
    below: str = ""


class Robot(Struct, frozen=True):
    """A robot, or the part of one that policies move.

    - ``key``: what ``--robot`` takes; rows of one robot with other joints share it up to a dash.
    - ``sides``: beginnings of joints' names that change places in the mirror.
    - ``turned``: words in the names of joints whose sign the mirror changes.
    - ``orders``: orders of joints that projects use beside those of the tree.
    - ``told``: joint → its partner and its sign, where a user's file says them; goes before ``sides`` and ``turned``.
    - ``source``: where it is from.
    """

    key: str
    title: str
    chains: tuple[Chain, ...]
    sides: tuple[tuple[str, str], ...]
    turned: tuple[str, ...]
    source: str
    orders: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    told: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    @property
    def joints(self) -> tuple[str, ...]:
        """Its joints in the order of its model file."""
        return _in_turn(self.chains)

    @property
    def one_side(self) -> list[str]:
        """Of each pair of joints that are mirror images, the first of its model file: left, or right."""
        return [j for i, j in enumerate(self.joints) if self.joints.index(self.partner(j)) > i]

    def all_orders(self) -> dict[str, tuple[str, ...]]:
        """Name of an order → its joints, each order once."""
        found = {DEPTH: self.joints, BREADTH: level_by_level(self.chains), **self.orders}
        return {name: joints for name, joints in found.items() if joints not in _before(found, name)}

    def partner(self, joint: str) -> str:
        """The joint on the other side, or itself."""
        if joint in self.told:
            return self.told[joint][0]
        for left, right in self.sides:
            for own, other in ((left, right), (right, left)):
                if joint.startswith(own):
                    return other + joint[len(own) :]
        return joint

    def sign(self, joint: str) -> int:
        """-1 where the mirror changes the joint's sign, else 1."""
        if joint in self.told:
            return self.told[joint][1]
        return -1 if any(word in joint for word in self.turned) else 1


def _before(orders: Mapping[str, tuple[str, ...]], name: str) -> list[tuple[str, ...]]:
    names = list(orders)
    return [orders[n] for n in names[: names.index(name)]]


def level_by_level(chains: Sequence[Chain]) -> tuple[str, ...]:
    """The joints breadth first, those of a level in the order of the chains."""
    levels: dict[str, int] = {}
    for chain in chains:
        start = levels[chain.below] + 1 if chain.below else 0
        levels.update({joint: start + i for i, joint in enumerate(chain.joints)})
    # siblings stand in the order of their parents, which a stable sort keeps
    return tuple(sorted(levels, key=levels.__getitem__))


def _limbs(names: Sequence[str], parts: str, below: str = "") -> tuple[Chain, ...]:
    """A chain for each limb: its name before each of the parts (``{}`` stands for the name)."""
    return tuple(Chain(tuple(part.format(name) for part in parts.split()), below) for name in names)


def _in_turn(chains: Sequence[Chain]) -> tuple[str, ...]:
    return tuple(joint for chain in chains for joint in chain.joints)


_BOTH = ("left", "right")
_SIDES = (("left_", "right_"),)
_LATERAL = ("roll", "yaw")

_G1_LEGS = _limbs(
    _BOTH,
    "{}_hip_pitch_joint {}_hip_roll_joint {}_hip_yaw_joint {}_knee_joint {}_ankle_pitch_joint {}_ankle_roll_joint",
)
_G1_ARM = "{}_shoulder_pitch_joint {}_shoulder_roll_joint {}_shoulder_yaw_joint {}_elbow_joint {}_wrist_roll_joint"
_G1_HAND = " {}_wrist_pitch_joint {}_wrist_yaw_joint"
_H1_2_LEG = (
    "{}_hip_yaw_joint {}_hip_pitch_joint {}_hip_roll_joint {}_knee_joint {}_ankle_pitch_joint {}_ankle_roll_joint"
)
_H1_LEG = "{}_hip_yaw_joint {}_hip_roll_joint {}_hip_pitch_joint {}_knee_joint {}_ankle_joint"
_H1_ARM = "{}_shoulder_pitch_joint {}_shoulder_roll_joint {}_shoulder_yaw_joint {}_elbow_joint"
_T1_LEG = "{}_Hip_Pitch {}_Hip_Roll {}_Hip_Yaw {}_Knee_Pitch {}_Ankle_Pitch {}_Ankle_Roll"
_T1_ARM = "{}_Shoulder_Pitch {}_Shoulder_Roll {}_Elbow_Pitch {}_Elbow_Yaw"
_T1_HAND = " {}_Wrist_Pitch {}_Wrist_Yaw {}_Hand_Roll"
_T1_HEAD = Chain(("AAHead_yaw", "Head_pitch"))
_T1_BOTH = ("Left", "Right")
_T1_SIDES = (("Left_", "Right_"),)
_T1_LATERAL = ("Roll", "Yaw", "yaw", "Waist")
_GR1_LEG = "{}_hip_roll {}_hip_yaw {}_hip_pitch {}_knee_pitch {}_ankle_pitch"
_DOG = "{}_hip_joint {}_thigh_joint {}_calf_joint"
_DOG_LEGS, _DOG_SIDES = ("FL", "FR", "RL", "RR"), (("FL", "FR"), ("RL", "RR"))
_ANYMAL_SIDES = (("LF", "RF"), ("LH", "RH"))

_GYM = "unitreerobotics/unitree_rl_gym@276801e resources/robots/"
_LAB = "fan-ziqi/robot_lab@09f7fb4 source/robot_lab/data/Robots/"
_HOLOSOMA = "amazon-far/holosoma@fc600e7, dof_names in the metadata of its policies"
_MENAGERIE = "google-deepmind/mujoco_menagerie@483d231 "


def _dog(key: str, title: str, source: str, legs: tuple[str, ...] = _DOG_LEGS) -> Robot:
    return Robot(key, title, _limbs(legs, _DOG), _DOG_SIDES, ("hip",), source)


def _wheeled_dog(key: str, title: str, source: str) -> Robot:
    legs = _limbs(("FR", "FL", "RR", "RL"), _DOG)
    wheels = tuple(f"{leg}_foot_joint" for leg in ("FR", "FL", "RR", "RL"))
    chains = tuple(Chain((*leg.joints, wheel)) for leg, wheel in zip(legs, wheels, strict=True))
    apart = _in_turn(legs) + wheels
    return Robot(key, title, chains, _DOG_SIDES, ("hip",), source, orders={"legs, then wheels": apart})


ROBOTS: tuple[Robot, ...] = (
    Robot(
        "g1",
        "Unitree G1, 29 joints",
        (
            *_G1_LEGS,
            Chain(("waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint")),
            *_limbs(_BOTH, _G1_ARM + _G1_HAND, "waist_pitch_joint"),
        ),
        _SIDES,
        _LATERAL,
        f"{_GYM}g1_description/g1_29dof_rev_1_0.xml",
    ),
    Robot(
        "g1-27",
        "Unitree G1 with its waist locked, 27 joints",
        (*_G1_LEGS, Chain(("waist_yaw_joint",)), *_limbs(_BOTH, _G1_ARM + _G1_HAND, "waist_yaw_joint")),
        _SIDES,
        _LATERAL,
        f"{_GYM}g1_description/g1_29dof_lock_waist_rev_1_0.xml",
    ),
    Robot(
        "g1-23",
        "Unitree G1, 23 joints",
        (*_G1_LEGS, Chain(("waist_yaw_joint",)), *_limbs(_BOTH, _G1_ARM, "waist_yaw_joint")),
        _SIDES,
        _LATERAL,
        f"{_GYM}g1_description/g1_23dof_rev_1_0.xml",
    ),
    Robot("g1-legs", "Unitree G1, its legs", _G1_LEGS, _SIDES, _LATERAL, f"{_GYM}g1_description/g1_12dof.xml"),
    Robot(
        "h1",
        "Unitree H1, 19 joints",
        (
            *_limbs(_BOTH, _H1_LEG),
            Chain(("torso_joint",)),
            *_limbs(_BOTH, _H1_ARM, "torso_joint"),
        ),
        _SIDES,
        (*_LATERAL, "torso"),
        f"{_MENAGERIE}unitree_h1/h1.xml",
    ),
    Robot("h1-legs", "Unitree H1, its legs", _limbs(_BOTH, _H1_LEG), _SIDES, _LATERAL, f"{_GYM}h1/h1.xml"),
    Robot(
        "h1_2",
        "Unitree H1_2, 27 joints",
        (
            *_limbs(_BOTH, _H1_2_LEG),
            Chain(("torso_joint",)),
            *_limbs(_BOTH, _G1_ARM + _G1_HAND, "torso_joint"),
        ),
        _SIDES,
        (*_LATERAL, "torso"),
        f"{_GYM}h1_2/h1_2.xml",
    ),
    Robot(
        "h1_2-legs", "Unitree H1_2, its legs", _limbs(_BOTH, _H1_2_LEG), _SIDES, _LATERAL, f"{_GYM}h1_2/h1_2_12dof.xml"
    ),
    Robot(
        "t1",
        "Booster T1, 23 joints",
        (_T1_HEAD, *_limbs(_T1_BOTH, _T1_ARM), Chain(("Waist",)), *_limbs(_T1_BOTH, _T1_LEG, "Waist")),
        _T1_SIDES,
        _T1_LATERAL,
        f"{_LAB}booster/t1_description/urdf/robot.urdf",
    ),
    Robot(
        "t1-29",
        "Booster T1, 29 joints",
        (_T1_HEAD, *_limbs(_T1_BOTH, _T1_ARM + _T1_HAND), Chain(("Waist",)), *_limbs(_T1_BOTH, _T1_LEG, "Waist")),
        _T1_SIDES,
        _T1_LATERAL,
        _HOLOSOMA,
    ),
    Robot(
        "t1-legs",
        "Booster T1, its legs",
        _limbs(_T1_BOTH, _T1_LEG),
        _T1_SIDES,
        _T1_LATERAL,
        "BoosterRobotics/booster_gym@da396a0 deploy/utils/policy.py",
    ),
    Robot(
        "gr1-legs",
        "Fourier GR1T1 and GR1T2, their legs",
        _limbs(("l", "r"), _GR1_LEG),
        (("l_", "r_"),),
        _LATERAL,
        f"{_LAB}fftai/gr1t1_description/urdf/GR1T1_lower_limb.urdf",
    ),
    Robot(
        "xbot-legs",
        "RobotEra XBot-L, its legs",
        _limbs(
            _BOTH,
            "{}_leg_roll_joint {}_leg_yaw_joint {}_leg_pitch_joint {}_knee_joint {}_ankle_pitch_joint "
            "{}_ankle_roll_joint",
        ),
        _SIDES,
        ("leg", "knee", "ankle"),  # its axes are turned by half a turn from one leg to the other
        "roboterax/humanoid-gym@ae46e20 resources/robots/XBot/urdf/XBot-L.urdf",
    ),
    Robot(
        "berkeley-humanoid",
        "Berkeley Humanoid",
        _limbs(("LL", "LR"), "{}_HR {}_HAA {}_HFE {}_KFE {}_FFE {}_FAA"),
        (("LL", "LR"),),
        ("HR", "HAA", "FAA"),
        f"{_MENAGERIE}berkeley_humanoid/berkeley_humanoid.xml",
    ),
    _dog("go2", "Unitree Go2", f"{_LAB}unitree/go2_description/urdf/go2_description.urdf"),
    _dog("go1", "Unitree Go1", "mujocolab/mjlab@0eda4e7 unitree_go1/xmls/go1.xml", ("FR", "FL", "RR", "RL")),
    _dog("a1", "Unitree A1", f"{_LAB}unitree/a1_description/urdf/a1.urdf", ("FR", "FL", "RR", "RL")),
    _dog("b2", "Unitree B2", f"{_LAB}unitree/b2_description/urdf/b2_description.urdf"),
    _wheeled_dog("go2w", "Unitree Go2-W", f"{_LAB}unitree/go2w_description/urdf/go2w_description.urdf"),
    _wheeled_dog("b2w", "Unitree B2-W", f"{_LAB}unitree/b2w_description/urdf/b2w_description.urdf"),
    Robot(
        "lite3",
        "DEEP Robotics Lite3",
        _limbs(("FL", "FR", "HL", "HR"), "{}_HipX_joint {}_HipY_joint {}_Knee_joint"),
        (("FL", "FR"), ("HL", "HR")),
        ("HipX",),
        f"{_LAB}deeprobotics/lite3_description/urdf/lite3.urdf",
    ),
    Robot(
        "anymal",
        "ANYbotics ANYmal B, C and D",
        _limbs(("LF", "RF", "LH", "RH"), "{}_HAA {}_HFE {}_KFE"),
        _ANYMAL_SIDES,
        ("HAA",),
        "leggedrobotics/legged_gym@8fa29ac resources/robots/anymal_c/urdf/anymal_c.urdf",
        orders={"left legs first (Isaac Gym)": _in_turn(_limbs(("LF", "LH", "RF", "RH"), "{}_HAA {}_HFE {}_KFE"))},
    ),
    Robot(
        "tita",
        "Direct Drive Tita",
        _limbs(("left", "right"), "joint_{}_leg_1 joint_{}_leg_2 joint_{}_leg_3 joint_{}_leg_4"),
        (("joint_left", "joint_right"),),
        ("leg_1",),
        f"{_LAB}ddt/tita_description/urdf/tita.urdf",
        orders={
            "legs, then wheels": (
                *(f"joint_{side}_leg_{i}" for side in ("left", "right") for i in (1, 2, 3)),
                "joint_left_leg_4",
                "joint_right_leg_4",
            )
        },
    ),
)
