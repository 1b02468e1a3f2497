"""Addresses of the arm's joints and commands, the gripper and the tool in a compiled model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.effects.select import SINGLE, driven_joints, servo_gain
from concent_warp.errors import TrainError
from concent_warp.train.cfg import ActionCfg
from concent_warp.train.task.held_arm import holding_leads

JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
DYNAMICS = mujoco.mjtDyn
KEEPS_UNIT = (int(DYNAMICS.mjDYN_NONE), int(DYNAMICS.mjDYN_FILTER), int(DYNAMICS.mjDYN_FILTEREXACT))
"""Dynamics of actuators whose input is in the unit of the command; an integrator's is the rate of it."""


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
    """Largest difference of each arm command and its joint beyond `hold`, shape (J,)."""
    hold: np.ndarray
    """Difference of each arm command and its joint with which the servos hold the arm against gravity, the middle of
    the range along the demonstration, shape (J,); 0 where gravity is compensated."""
    in_metres: bool = True
    """Whether the gripper's commands are lengths [m], as of fingers that slide; else they are in a unit of its own."""

    @property
    def actions(self) -> int:
        """Length A of an action."""
        return len(self.step)

    @staticmethod
    def of(m: mujoco.MjModel, cfg: ActionCfg) -> Robot:
        """Return the robot of a compiled model.

        Raises:
            TrainError: The tool site or a named actuator is missing, an actuator of the arm takes no position of a
                hinge or slide joint as its command, or those of the gripper cannot share one number.
        """
        names = [m.actuator(i).name for i in range(m.nu)]
        missing = [name for name in cfg.gripper_actuators if name not in names]
        if missing and cfg.gripper_actuators != ActionCfg.gripper_actuators:
            raise TrainError(
                f"the robot has no actuator {missing[0]!r}",
                found=names,
                fix="name those of the gripper with --environment.action.gripper-actuators",
            )
        gripper = [names.index(name) for name in cfg.gripper_actuators if name in names]
        actuator = [i for i in range(m.nu) if i not in gripper]
        for i in actuator:
            _check_servo(m, i)
        step, in_metres = _gripper_step(m, gripper, cfg)
        tool = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, cfg.tool_site)
        if tool < 0:
            raise TrainError(
                "the robot has no tool site",
                expected=cfg.tool_site,
                found=[m.site(i).name for i in range(m.nsite)],
                fix="name one with --environment.action.tool-site"
                + ("" if m.nsite else ", after adding it to the scene: <site> in the body of the hand"),
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
            step=np.append(np.where(turning, cfg.turn, cfg.slide), [step] * bool(gripper)),
            lead=np.where(turning, cfg.turn_lead, cfg.slide_lead),
            hold=np.zeros(len(joint)),
            in_metres=in_metres,
        )

    def holding(self, m: mujoco.MjModel, qpos: np.ndarray) -> Robot:
        """Return the robot with leads counted from the commands that hold it at positions (K, nq).

        Where these commands differ along the way, leads are larger by half of their range.
        """
        leads = holding_leads(m, mujoco.MjData(m), self.actuator, qpos)
        low, high = leads.min(axis=0), leads.max(axis=0)
        return replace(self, hold=(low + high) / 2, lead=self.lead + (high - low) / 2)


def _check_servo(m: mujoco.MjModel, i: int) -> None:
    """Check that an actuator of the arm takes the position of its joint as command, which is what a policy steps.

    Raises:
        TrainError: It drives no hinge or slide joint, takes another command, or has a gear.
    """
    name = m.actuator(i).name
    if int(m.actuator_trntype[i]) not in JOINTS or int(m.jnt_type[m.actuator_trnid[i, 0]]) not in SINGLE:
        raise TrainError(
            f"actuator {name!r} drives no hinge or slide joint",
            fix="name those of the gripper, or of a suction cup, with --environment.action.gripper-actuators",
        )
    if not _takes_position(m, i):
        raise TrainError(
            f"the command of actuator {name!r} is no position of its joint, and a policy steps positions",
            expected="<position> actuators for all joints of the arm",
            found="a torque, a velocity or another command",
            fix='model the arm as servos and record positions as their commands: docs/own_robot.md, "A policy"',
        )
    if (gear := float(m.actuator_gear[i, 0])) != 1:
        raise TrainError(
            f"actuator {name!r} has a gear",
            expected=1,
            found=gear,
            fix="multiply its kp and kv by the square of the gear, and divide ctrlrange and recorded commands by it",
        )


def _takes_position(m: mujoco.MjModel, i: int) -> bool:
    """Return whether an actuator drives its joint or tendon to the length that is its command."""
    return servo_gain(m, i) > 0 and int(m.actuator_dyntype[i]) in KEEPS_UNIT


def _gripper_step(m: mujoco.MjModel, gripper: list[int], cfg: ActionCfg) -> tuple[float, bool]:
    """Return the largest step of the gripper's command, and whether it is in metres; if not, it is a share of a range.

    Raises:
        TrainError: The actuators have steps of different sizes, or a command without a unit has no range.
    """
    steps: dict[str, tuple[float, bool]] = {}
    for i in gripper:
        name, joints = m.actuator(i).name, driven_joints(m, i)
        if int(m.actuator_dyntype[i]) not in KEEPS_UNIT:
            raise TrainError(
                f"the gripper's actuator {name!r} integrates its command, or has a state of another kind",
                expected="no dynamics, or a filter (timeconst)",
                fix="use an actuator such as <position>",
            )
        turns = any(int(m.jnt_type[j]) != int(mujoco.mjtJoint.mjJNT_SLIDE) for j in joints)
        if _takes_position(m, i) and not turns:
            steps[name] = cfg.gripper, True
        elif m.actuator_ctrllimited[i]:
            _check_angles(m, i)
            steps[name] = cfg.gripper_share * float(np.ptp(m.actuator_ctrlrange[i])), False
        else:
            raise TrainError(
                f"the gripper's actuator {name!r} has no range of commands, of which a step could be a share",
                fix="give it a ctrlrange",
            )
    if len(set(steps.values())) > 1:
        raise TrainError(
            "one number cannot command all actuators of the gripper, whose largest steps differ",
            found={name: step for name, (step, _) in steps.items()},
            fix="give them the same kind of command and the same ctrlrange, or couple them by one tendon",
        )
    return next(iter(steps.values()), (cfg.gripper, True))


def _check_angles(m: mujoco.MjModel, i: int) -> None:
    """Check that the range of a gripper's servo is not in degrees, which MuJoCo takes for radians.

    Raises:
        TrainError: The range begins or ends more than a turn outside that of the hinge.
    """
    joint = int(m.actuator_trnid[i, 0])
    if not _takes_position(m, i) or int(m.actuator_trntype[i]) not in JOINTS or not m.jnt_limited[joint]:
        return
    gear, commands = float(m.actuator_gear[i, 0]), m.actuator_ctrlrange[i]
    low, high = sorted(gear * m.jnt_range[joint])
    if commands[0] < low - 2 * np.pi * abs(gear) or commands[1] > high + 2 * np.pi * abs(gear):
        raise TrainError(
            f"the ctrlrange of the gripper's actuator {m.actuator(i).name!r} is far beyond its joint, as if in degrees",
            expected=f"rad, about {low:.4g} to {high:.4g}",
            found=f"{commands[0]:g} to {commands[1]:g}",
            fix="write radians, which <compiler angle> does not do for ctrlrange, or inheritrange='1'",
        )


def _opening(m: mujoco.MjModel, gripper: list[int]) -> np.ndarray:
    """Return the weights, shape (nq,), with which positions sum to the mean length of the gripper's actuators.

    A suction cup, which drives no joint, has none.
    """
    weights = np.zeros(m.nq)
    for i in gripper:
        target = int(m.actuator_trnid[i, 0])
        if int(m.actuator_trntype[i]) == mujoco.mjtTrn.mjTRN_TENDON:
            wraps = range(m.tendon_adr[target], m.tendon_adr[target] + m.tendon_num[target])
            for w in wraps:
                if int(m.wrap_type[w]) == mujoco.mjtWrap.mjWRAP_JOINT:
                    weights[m.jnt_qposadr[m.wrap_objid[w]]] += m.wrap_prm[w] / len(gripper)
        elif int(m.actuator_trntype[i]) in JOINTS:
            weights[m.jnt_qposadr[target]] += 1 / len(gripper)
    return weights
