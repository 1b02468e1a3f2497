"""The embedded robot: a 7-DoF arm with a parallel gripper, primitives only, after the Franka Emika Panda.

Sources of the values:

- kinematics (modified Denavit-Hartenberg), limits of position and torque: Franka Control Interface
  documentation, "Robot and interface specifications";
- link masses, centres of mass and inertias: the `inertial` elements of `franka_description`, which follow Gaz et al.,
  "Dynamic identification of the Franka Emika Panda robot with retrieval of feasible parameters using penalty-based
  optimization", IEEE RA-L 4(4), 2019; hand: 0.73 kg, the Franka Hand's data sheet;
- stiffness of the position control: the gains of `joint_impedance_example_controller` of franka_ros, as is the damping
  of the first four joints; the wrist's is lowered so that all joints lag their command by about 80 ms;
- rotor inertias are not published; 0.1 kg m^2 a joint is an assumption shared with other MuJoCo models of this arm.

The shapes are capsules and boxes around the links, for display and collision; their sizes are not measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import SceneError
from concent_warp.scene.read_mjcf import spec_from_file

DH = (
    # a [m], d [m], alpha [rad]
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
)
JOINT_RANGES = (
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (-0.0175, 3.7525),
    (-2.8973, 2.8973),
)
"""Joint limits [rad]."""
MAX_TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Joint torque limits [N m]."""
STIFFNESS = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)
"""Position control, proportional gain [N m/rad]."""
DAMPING = (50.0, 50.0, 50.0, 50.0, 18.0, 11.0, 4.0)
"""Position control, velocity gain [N m s/rad]."""
ARMATURE = 0.1
"""Rotor inertia seen at the joint [kg m^2]."""
LINK_INERTIAS = (
    # mass [kg], centre of mass [m], inertia xx yy zz xy xz yz [kg m^2], link frame
    (4.970684, (3.875e-3, 2.081e-3, -0.04762), (0.70337, 0.70661, 9.117e-3, -1.39e-4, 6.772e-3, 0.019169)),
    (0.646926, (-3.141e-3, -0.02872, 3.495e-3), (7.962e-3, 0.02811, 0.025995, -3.925e-3, 0.010254, 7.04e-4)),
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -4.761e-3, -0.011396, -0.012805)),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 7.796e-3, -1.332e-3, 8.641e-3)),
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 8.627e-3, -2.117e-3, -4.037e-3, 2.29e-4)),
    (1.666555, (0.060149, -0.014117, -0.010517), (1.964e-3, 4.354e-3, 5.433e-3, 1.09e-4, -1.158e-3, 3.41e-4)),
    (0.735522, (0.010517, -4.252e-3, 0.061597), (0.012516, 0.010027, 4.815e-3, -4.28e-4, -1.196e-3, -7.41e-4)),
)
FLANGE_OFFSET = 0.107
"""From the last joint frame to the flange, along z [m]."""
TCP_OFFSET = 0.1034
"""From the flange to the point between the fingertips, along z [m]."""
HOME_ANGLES = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)
"""The ready pose of Franka's tutorials [rad]."""
LINK_CAPSULES = (
    # capsules around each link: from, to [m] in the link frame, radius [m]
    ((0, 0, -0.192, 0, 0, -0.02, 0.055),),
    ((0, -0.015, 0, 0, -0.17, 0, 0.055),),
    ((0, 0, -0.125, 0, 0, -0.01, 0.055), (0, 0.0, 0.0, 0.0825, 0.0, 0.0, 0.05)),
    ((0, 0, 0, -0.0825, 0.07, 0, 0.05),),
    ((0, 0, -0.22, 0, 0.055, -0.10, 0.04), (0, 0.03, -0.10, 0, 0.0, -0.02, 0.045)),
    ((0, 0, -0.02, 0.088, 0, 0.0, 0.045),),
    ((0, 0, 0.02, 0, 0, 0.085, 0.042),),
)
FINGER_TRAVEL = 0.04
"""Travel of each finger [m]."""
GRIP_FORCE = 40.0
"""Force limit of the gripper, on each finger [N]; the Franka Hand holds 70 N continuously."""
GRIP_STIFFNESS = 4000.0
"""Position control of the fingers [N/m]."""
PAD_HALF_SIZES = (0.0085, 0.004, 0.0095)
"""Half sizes of the finger pads, along x, along the closing direction, along z [m]."""


@dataclass(frozen=True)
class RobotCfg:
    """Robot of the scene, and the names of its tool site and gripper actuators."""

    path: Path | None = None
    """MJCF of the robot; None is the embedded arm."""
    tcp_site: str = "tcp"
    """Site between the fingertips: z points out of the hand, y along the closing direction."""
    gripper_actuators: tuple[str, ...] = ("gripper",)
    """Actuators that open the gripper (largest control value) and close it (smallest)."""

    def build(self) -> mujoco.MjSpec:
        """Return the robot alone, base at the origin.

        Raises:
            SceneError: The MJCF cannot be read, or lacks the site or the actuators named here.
        """
        if self.path is None:
            return panda()
        if not self.path.is_file():
            raise SceneError("no such robot file", where=self.path, fix="check the path given with --robot")
        spec = spec_from_file(self.path)
        if spec.site(self.tcp_site) is None:
            sites = [site.name for site in spec.sites]
            raise SceneError(
                f"the robot has no site {self.tcp_site!r} between its fingertips",
                where=self.path,
                expected="a site to steer",
                found=sites,
                fix="name one with --robot.tcp-site",
            )
        actuators = [actuator.name for actuator in spec.actuators]
        if missing := [name for name in self.gripper_actuators if name not in actuators]:
            raise SceneError(
                f"the robot lacks gripper actuators {missing}",
                where=self.path,
                found=actuators,
                fix="name them with --robot.gripper-actuators",
            )
        return spec


def panda() -> mujoco.MjSpec:
    """Return the embedded arm with its gripper, position-controlled, base at the origin."""
    spec = mujoco.MjSpec()
    spec.modelname = "arm"
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name="link0")
    base = body.add_geom(name="link0", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[-0.06, 0, 0.06, 0, 0, 0.06])
    base.size[0] = 0.06
    _paint(base, white=True)
    for i, (a, d, alpha) in enumerate(DH):
        body = body.add_body(
            name=f"link{i + 1}",
            pos=[a, -np.sin(alpha) * d, np.cos(alpha) * d],
            quat=[np.cos(alpha / 2), np.sin(alpha / 2), 0, 0],
            gravcomp=1.0,
        )
        mass, com, inertia = LINK_INERTIAS[i]
        body.explicitinertial = True
        body.mass, body.ipos, body.fullinertia = mass, list(com), list(inertia)
        body.add_joint(
            name=f"joint{i + 1}",
            axis=[0, 0, 1],
            range=list(JOINT_RANGES[i]),
            limited=True,
            armature=ARMATURE,
            damping=[1, 0, 0],
        )
        for k, (*ends, radius) in enumerate(LINK_CAPSULES[i]):
            geom = body.add_geom(name=f"link{i + 1}_{k}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends)
            geom.size[0] = radius
            _paint(geom, white=i % 2 == 0)
        actuator = spec.add_actuator(name=f"joint{i + 1}", target=f"joint{i + 1}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=STIFFNESS[i], kv=DAMPING[i])
        actuator.ctrlrange, actuator.ctrllimited = list(JOINT_RANGES[i]), True
        actuator.forcerange, actuator.forcelimited = [-MAX_TORQUE[i], MAX_TORQUE[i]], True
        spec.add_sensor(
            name=f"joint{i + 1}_position",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=f"joint{i + 1}",
        )
    _add_hand(spec, body)
    for i in range(7):
        for j in range(i, 7):
            spec.add_exclude(bodyname1=f"link{i}", bodyname2=f"link{j + 1}")
    return spec


def _add_hand(spec: mujoco.MjSpec, flange: mujoco.MjsBody) -> None:
    """Add the parallel gripper to the last link: two fingers coupled by an equality, closed by one actuator."""
    turn = -np.pi / 4
    hand = flange.add_body(
        name="hand", pos=[0, 0, FLANGE_OFFSET], quat=[np.cos(turn / 2), 0, 0, np.sin(turn / 2)], gravcomp=1.0
    )
    hand.explicitinertial = True
    hand.mass, hand.ipos, hand.inertia = 0.73, [-0.01, 0, 0.03], [0.001, 0.0025, 0.0017]
    _paint(hand.add_geom(name="hand", type=mujoco.mjtGeom.mjGEOM_BOX, pos=[0, 0, 0.033], size=[0.02, 0.1, 0.033]))
    hand.add_site(name="tcp", pos=[0, 0, TCP_OFFSET], size=[0.004, 0.004, 0.004], group=4)
    for name, side in (("left_finger", 1.0), ("right_finger", -1.0)):
        finger = hand.add_body(name=name, pos=[0, 0, 0.0584], gravcomp=1.0)
        finger.explicitinertial = True
        finger.mass, finger.ipos, finger.inertia = 0.015, [0, side * 0.0145, 0.022], [2.4e-6, 2.4e-6, 7.5e-7]
        finger.add_joint(
            name=f"{name}_joint",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0, side, 0],
            range=[0, FINGER_TRAVEL],
            limited=True,
            armature=0.1,
            damping=[20, 0, 0],
        )
        _paint(
            finger.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=[0, side * 0.016, 0.018], size=[0.0105, 0.0075, 0.018]
            ),
            white=True,
        )
        pad = finger.add_geom(
            name=f"{name}_pad",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0, side * PAD_HALF_SIZES[1], TCP_OFFSET - 0.0584],
            size=list(PAD_HALF_SIZES),
            friction=[1.0, 0.01, 0.0001],
            condim=4,
        )
        _paint(pad)
    equality = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1="left_finger_joint",
        name2="right_finger_joint",
    )
    equality.data[1] = 1.0
    equality.solref = [0.005, 1.0]
    tendon = spec.add_tendon(name="grip")
    tendon.wrap_joint("left_finger_joint", 0.5)
    tendon.wrap_joint("right_finger_joint", 0.5)
    actuator = spec.add_actuator(name="gripper", target="grip", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    actuator.set_to_position(kp=GRIP_STIFFNESS, kv=80.0)
    actuator.ctrlrange, actuator.ctrllimited = [0, FINGER_TRAVEL], True
    actuator.forcerange, actuator.forcelimited = [-2 * GRIP_FORCE, 2 * GRIP_FORCE], True
    spec.add_sensor(
        name="gripper_opening",
        type=mujoco.mjtSensor.mjSENS_TENDONPOS,
        objtype=mujoco.mjtObj.mjOBJ_TENDON,
        objname="grip",
    )
    for a, b in (
        ("hand", "left_finger"),
        ("hand", "right_finger"),
        ("link7", "hand"),
        ("link7", "left_finger"),
        ("link7", "right_finger"),
        ("left_finger", "right_finger"),
        ("link6", "hand"),
        ("link5", "hand"),
    ):
        spec.add_exclude(bodyname1=a, bodyname2=b)


def _paint(geom: mujoco.MjsGeom, *, white: bool = False) -> None:
    """Give a robot geom its colour."""
    geom.rgba = [0.92, 0.93, 0.94, 1] if white else [0.30, 0.33, 0.37, 1]
