"""Public policies on which no bound of a decision was chosen, each with the layout that it truly has, and where that is
said: its deploy.yaml, ONNX metadata or IO descriptors, else the program that feeds it.

None is in this repository. ``order`` is how an order of the robot's begins ("as in its model file", "level by level",
"legs, then wheels"); a file in its place, or "beside", states the layout. A policy of a robot that has no row stands
under one whose joints mirror alike.
"""

from __future__ import annotations

from typing import NamedTuple


class Case(NamedTuple):
    """A policy, its robot, order, project (which says its terms), frames and stacking."""

    repository: str
    path: str
    robot: str = ""
    order: str = "beside"
    project: str = ""
    frames: int = 1
    stacked: str = ""


LAB, HIM, WHOLE = "robot_lab, unitree_rl_lab", "HIMLoco", "legged_gym"
_DEPLOY = "deploy/robots/{}/config/policy/{}/exported/policy.onnx"
_RENKUN, _DOGS, _KATARI = "Renkunzhao/legged_rl_deploy", "lyz1202dt/AT_robot-lab", "katari16/go2_rl_lab"
_H12, _H12_MODELS = "correlllab/unitree_h12_sim2sim", "mujoco/model_and_yaml"
_KUAVO, _HISTORY = "models/kuavo42_legged/Kuavo42_legged", "policy_isaaclab_propioceptive"
_AS, _LEVEL = "as", "level"

HELD_BACK = (
    *(
        Case(repository, _DEPLOY.format(robot, version))
        for repository, robot, version in (
            ("27daiwu/unitree_rl_mjlab", "g1", "blind"),
            ("27daiwu/unitree_rl_mjlab", "g1", "walk/v0"),
            ("Abanesjo/unitree_rl_mjlab", "g1", "velocity/v0"),
            ("Guo1ZY/TractionSense-G1", "g1_29dof", "velocity/v0"),
            ("PMY9527/unitree_rl_lab", "go2", "velocity/v0"),
            ("TR-ROBOTICS/unitree_rl_lab", "g1_29dof", "velocity/v0"),
            ("felipeosmar/unitree_rl_mjlab", "go2", "velocity/v0"),
            ("katazen/unitree_rl_lab", "g1_23dof", "velocity/qie_0519"),
            ("katazen/unitree_rl_lab", "g1_23dof", "velocity/qie_0525"),
            ("katazen/unitree_rl_lab", "g1_23dof", "velocity/qie_v0"),
            ("katazen/unitree_rl_lab", "g1_23dof", "velocity/qie_v1"),
            ("liamlate/unitree_rl_mjlab", "h1_2", "velocity/v0"),
            ("mht3/softmimic_mjlab", "g1_23dof", "velocity/v0"),
            ("sagrawal0410/unitree_rl_lab", "g1_29dof", "velocity/v0"),
            ("Jme1789/g1_commanded_locomotion_mjlab", "g1", "velocity/v1"),
        )
    ),
    Case(
        "liamlate/unitree_rl_mjlab", _DEPLOY.format("h1_2", "velocity/v0").replace("/policy.onnx", "/final_policy.onnx")
    ),
    Case(_RENKUN, "policies/g1/velocity/mjlab/policy.onnx"),
    Case(_RENKUN, "policies/go2/velocity/unitree_rl_lab/policy.onnx", "go2", _LEVEL, LAB),
    Case(_RENKUN, "policies/go2/handstand/policy.onnx", "go2", _AS, WHOLE),
    Case(_RENKUN, "policies/go2/legstand/policy.onnx", "go2", _AS, WHOLE),
    Case("DeepRoboticsLab/Lite3_rl_deploy", "policy/ppo/policy.onnx", "lite3", _AS, LAB),
    Case("ALLTRON-Xiao/Dancing-Robot", "deploy/pre_train/g1/motion.pt", "g1-23", _AS, "unitree_rl_gym"),
    Case("chenci107/Unitree_Go2_Deployment", "deploy/pre_train/go2/motion.pt", "go2", _AS, LAB),
    Case("wty-yy/go2_rl_gym", "deploy/pre_train/go2/go2_cts_150k.pt", "go2", _AS, LAB),
    Case("pkfancy/sim2sim", "policy.pt", "go2", _LEVEL, WHOLE),
    Case("chelsivici/go2", "policy.pt", "go2", _LEVEL, WHOLE),
    Case("bhwxzx/rl_sar", "policy/go2w/robot_lab/policy.pt", "go2w", "legs, then", LAB),
    Case(_DOGS, "policy/go2/robot_lab/policy.pt", "go2", _AS, LAB),
    Case(_DOGS, "policy/d1/robot_lab/policy.pt", "go2", _AS, LAB),
    *(
        Case(_KATARI, f"deploy/pre_train/policy_{name}.pt", "go2", _LEVEL, LAB)
        for name in (
            *("dc_cfg_comparasion", "isaaclab_propioceptive", "isaaclab_propioceptive_scaled"),
            *("pace_cfg_comparasion", "pace_isaaclab", "scaling_tuned_rewards"),
        )
    ),
    *(
        Case("qyw23AI/HIMLocoWithDeploy", f"deploy_cpp/policy/policy{name}.pt", "go2", _AS, HIM, 6, "frame by frame")
        for name in ("", "_4000", "_best18000", "_last", "_old")
    ),
    *(
        Case("dduffffff/pt", f"{name}.pt", "go2", _AS, HIM, 6, "frame by frame")
        for name in (
            *("1.9", "3.8", "4.0", "gaosu_", "gs2", "gs2.36", "gs_1.9_2.45", "policy_87try"),
            *("policies/policy", "policies/policy_2"),
        )
    ),
    *(
        Case("wty-yy/humanoid-gym", f"models/g1/g1_ppo_{name}_model_3001.onnx", "g1-legs", _AS, "humanoid-gym")
        for name in ("v1", "v1.1")
    ),
    *(
        Case("wty-yy/humanoid-gym", f"{_KUAVO}_{name}.onnx", "berkeley-humanoid", _AS, "humanoid-gym")
        for name in (
            *("fine_ppo_v1_model_3001", "fine_ppo_v1.1_model_3001", "fine_ppo_v1.2_model_3001"),
            *("fine_ppo_v1.2.1_model_3001", "fine_ppo_v1.2.1_model_1100"),
            *("single_obs_ppo_v1_model_3001", "single_obs_ppo_v1.1_model_3001"),
        )
    ),
    *(
        Case(
            "wty-yy/humanoid-gym",
            f"{_KUAVO}_{name}.onnx",
            "berkeley-humanoid",
            _AS,
            "humanoid-gym",
            15,
            "frame by frame",
        )
        for name in ("ppo_v8_model_3001", "ppo_v8.2_model_3001", "ppo_v8.3_model_10001")
    ),
    *(
        Case(_H12, path, order=f"{_H12_MODELS}/walk/unitree_h12_walk_v0_IO_descriptors.yaml")
        for path in (
            *(f"{_H12_MODELS}/{task}/policy.pt" for task in ("walk", "stand")),
            "mujoco/external_model_and_yaml/walk_h12_niraj/policy.pt",
        )
    ),
    *(
        Case(
            "ImChong/RL_Sim2Sim_Demo_Website",
            f"public/examples/checkpoints/g1/walk_run_getup_rtx4090_{n}/model_{n}.onnx",
            *("g1", _AS, LAB, 4, "frame by frame"),
        )
        for n in ("50000", "59999")
    ),
)
