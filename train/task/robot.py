"""Addresses of the arm's joints and commands, the gripper and the tool in a compiled model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import TrainError
from concent_warp.train.cfg import ActionCfg


@dataclass(frozen=True)
class Robot:
    """Addresses in a compiled model; J arm joints, each driven by a position actuator of its own."""

    joint: np.ndarray
    """Joint ids, in the order of the actuators, shape (J,) int."""
    qpos: np.ndarray
    """Addresses of their positions, shape (J,) int."""
    dof: np.ndarray
    """Addresses of their velocities, shape (J,) int."""
    turning: np.ndarray
    """Whether a joint is a hinge, shape (J,) bool."""
    actuator: np.ndarray
    """Their actuators, shape (J,) int."""
    gripper: np.ndarray
    """Actuators of the gripper, commanded by one number, shape (G,) int; empty without a gripper."""
    opening: np.ndarray
    """Weights of the positions whose sum is the gripper opening, shape (nq,)."""
    tool: int
    """Id of the tool's site."""
    step: np.ndarray
    """Largest step of each command of the action, shape (A,), A = J, and one more with a gripper."""
    lead: np.ndarray
    """Largest difference of each arm command and its joint, shape (J,)."""

    @property
    def actions(self) -> int:
        """Length A of an action."""
        return len(self.step)

    @staticmethod
    def of(m: mujoco.MjModel, cfg: ActionCfg) -> Robot:
        """Return the robot of a compiled model.

        Raises:
            TrainError: The tool site is missing, or an actuator drives no hinge or slide joint.
        """
        names = [m.actuator(i).name for i in range(m.nu)]
        gripper = [names.index(name) for name in cfg.gripper_actuators if name in names]
        actuator = [i for i in range(m.nu) if i not in gripper]
        single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        for i in actuator:
            drives = int(m.actuator_trntype[i]) == mujoco.mjtTrn.mjTRN_JOINT
            if not drives or int(m.jnt_type[m.actuator_trnid[i, 0]]) not in single:
                raise TrainError(
                    f"actuator {names[i]!r} drives no hinge or slide joint", fix="name those of the gripper with "
                    "--environment.action.gripper-actuators",
                )  # fmt: skip
        tool = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, cfg.tool_site)
        if tool < 0:
            raise TrainError(
                "the robot has no tool site",
                expected=cfg.tool_site,
                found=[m.site(i).name for i in range(m.nsite)],
                fix="name one with --environment.action.tool-site",
            )
        joint = m.actuator_trnid[actuator, 0].astype(int)
        turning = m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        return Robot(
            joint=joint,
            qpos=m.jnt_qposadr[joint].astype(int),
            dof=m.jnt_dofadr[joint].astype(int),
            turning=turning,
            actuator=np.array(actuator, dtype=int),
            gripper=np.array(gripper, dtype=int),
            opening=_opening(m, gripper),
            tool=tool,
            step=np.append(np.where(turning, cfg.turn, cfg.slide), [cfg.gripper] * bool(gripper)),
            lead=np.where(turning, cfg.turn_lead, cfg.slide_lead),
        )


def _opening(m: mujoco.MjModel, gripper: list[int]) -> np.ndarray:
    """Return the weights, shape (nq,), with which positions sum to the mean length of the gripper's actuators."""
    weights = np.zeros(m.nq)
    for i in gripper:
        target = int(m.actuator_trnid[i, 0])
        if int(m.actuator_trntype[i]) == mujoco.mjtTrn.mjTRN_TENDON:
            wraps = range(m.tendon_adr[target], m.tendon_adr[target] + m.tendon_num[target])
            for w in wraps:
                if int(m.wrap_type[w]) == mujoco.mjtWrap.mjWRAP_JOINT:
                    weights[m.jnt_qposadr[m.wrap_objid[w]]] += m.wrap_prm[w] / len(gripper)
        else:
            weights[m.jnt_qposadr[target]] += 1 / len(gripper)
    return weights
