"""Conventions of projects: which terms an observation has, in what order, and how frames are stacked."""

from __future__ import annotations

from msgspec import Struct

#: How frames stand side by side: all frames of a term, or all terms of a frame.
BY_TERM, BY_FRAME = "term by term", "frame by frame"


class Convention(Struct, frozen=True):
    """A project's order of terms, its frames and how they are stacked (where there are several), and its source.

    ``newest_first`` says where the present stands; a mirror does not tell it.
    """

    project: str
    terms: tuple[str, ...]
    source: str
    frames: tuple[int, ...] = (1,)
    stacked: tuple[str, ...] = (BY_TERM, BY_FRAME)
    newest_first: bool | None = None


_JOINTS = ("joint_pos", "joint_vel", "last_action")
_BODY = ("base_ang_vel", "projected_gravity", "velocity_commands")
_WHOLE = ("base_lin_vel", *_BODY, *_JOINTS)

CONVENTIONS: tuple[Convention, ...] = (
    Convention("legged_gym", _WHOLE, "leggedrobotics/legged_gym@8fa29ac legged_gym/envs/base/legged_robot.py"),
    Convention(
        "legged_gym with heights",
        (*_WHOLE, "heights"),
        "leggedrobotics/legged_gym@8fa29ac legged_gym/envs/base/legged_robot.py",
    ),
    Convention(
        "Isaac Lab with a height scan",
        (*_WHOLE, "height_scan"),
        "isaac-sim/IsaacLab locomotion/velocity/velocity_env_cfg.py; GridPatternCfg, ordering xy",
    ),
    Convention(
        "robot_lab, unitree_rl_lab",
        (*_BODY, *_JOINTS),
        "unitreerobotics/unitree_rl_lab@e72a072 velocity_env_cfg.py (G1: 5 frames); fan-ziqi/rl_sar@e384912 policy/*",
        frames=(1, 4, 5, 6, 10),
        newest_first=False,
    ),
    Convention(
        "unitree_rl_gym",
        (*_BODY, *_JOINTS, "gait_phase"),
        "unitreerobotics/unitree_rl_gym@276801e legged_gym/envs/g1/g1_env.py",
        frames=(1, 5),
    ),
    Convention(
        "unitree_rl_mjlab",
        (*_BODY, "gait_phase", *_JOINTS),
        "unitreerobotics/unitree_rl_mjlab@5b7e396 mjlab/tasks/velocity",
        frames=(1, 5),
    ),
    Convention(
        "mjlab, MuJoCo Playground (four legs)",
        ("base_lin_vel", "base_ang_vel", "projected_gravity", *_JOINTS, "velocity_commands"),
        "mujocolab/mjlab@0eda4e7 velocity_env_cfg.py; google-deepmind/mujoco_playground@d5e6b47 go1/joystick.py",
    ),
    Convention(
        "MuJoCo Playground (two legs)",
        (*_WHOLE, "gait_phase_of_legs"),
        "google-deepmind/mujoco_playground@d5e6b47 _src/locomotion/g1/joystick.py",
    ),
    Convention(
        "humanoid-gym",
        ("gait_phase", "velocity_commands", *_JOINTS, "base_ang_vel", "base_euler"),
        "roboterax/humanoid-gym@ae46e20 humanoid/scripts/sim2sim.py",
        frames=(1, 15),
        newest_first=False,
    ),
    Convention(
        "HIMLoco",
        ("velocity_commands", "base_ang_vel", "projected_gravity", *_JOINTS),
        "OpenRobotLab/HIMLoco@ef289ac legged_gym/envs/base/legged_robot.py",
        frames=(1, 6),
        newest_first=True,
    ),
    Convention(
        "booster_gym",
        ("projected_gravity", "base_ang_vel", "velocity_commands", "gait_phase", *_JOINTS),
        "BoosterRobotics/booster_gym@da396a0 deploy/utils/policy.py",
    ),
    Convention(
        "holosoma, HumanoidVerse",
        (
            *("last_action", "base_ang_vel", "command_ang_vel", "command_lin_vel", "cos_phase"),
            *("joint_pos", "joint_vel", "projected_gravity", "sin_phase"),
        ),
        "amazon-far/holosoma@fc600e7 holosoma_inference/policies/base.py (terms sorted by name)",
    ),
    Convention(
        "Isaac Lab with feet",
        (*_BODY, "joint_pos", "joint_vel", "foot_contacts", "last_action"),
        "eppl-erau-db/go2_rl_ws@146a64d go2_rl_rough_actions_onnx.py",
    ),
)
