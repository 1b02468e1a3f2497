"""Contacts of the robot with objects: onsets of grasps and pushes, and the steps in which an object is grasped."""

from __future__ import annotations

import numpy as np

from concent_warp.events.cfg import StagingCfg
from concent_warp.events.filter import debounce, steps_of, true_runs, window_sums
from concent_warp.events.onset import Onset
from concent_warp.events.roles import Roles
from concent_warp.events.touches import BodyPoses, ReplayContacts


def robot_onsets(
    touches: ReplayContacts, motion: BodyPoses, roles: Roles, cfg: StagingCfg
) -> tuple[list[Onset], dict[int, np.ndarray]]:
    """Return the onsets of grasps and pushes, and when each object is grasped, shape (K,) bool by body id.

    The links of the robot count as one. A contact with an object is a grasp if the robot's normal forces on it add up
    to less than `max_net_force_ratio` of the sum of their magnitudes, over windows, for `min_state_duration`: then they
    press from opposite sides, or a suction cup draws the object that it presses. It begins with the first touch of that
    contact. Any other contact counts if it moves what it touches of the object by `min_displacement`, as a lever turns
    about its own origin, and as long as the robot has not grasped this object: touching it after its release opens no
    stage.
    """
    max_gap, shortest = steps_of(cfg.max_gap, motion.timestep), steps_of(cfg.min_contact_duration, motion.timestep)
    grasp, width = steps_of(cfg.min_state_duration, motion.timestep), steps_of(cfg.window, motion.timestep)
    initial = cfg.initial_duration / motion.timestep
    by_robot = touches[np.isin(touches.body[:, 0], roles.ids("robot"))]
    onsets: list[Onset] = []
    grasped: dict[int, np.ndarray] = {}
    for body in roles.ids("object"):
        rows = by_robot[by_robot.body[:, 1] == body]
        touching = debounce(rows.frames(motion.steps), max_gap, shortest)
        opposed = touching & forces_cancel(rows, motion.steps, width, cfg.max_net_force_ratio)
        grasping = debounce(opposed, max_gap, grasp) & touching
        grasped[body] = np.zeros(motion.steps, dtype=bool)
        seen: set[str] = set()
        for start, end in true_runs(touching):
            if grasping[start:end].any():
                kind = "pick"
                grasped[body][start:end] = True
            elif _displacement(rows[(rows.step >= start) & (rows.step < end)], motion, body) > cfg.min_displacement:
                kind = "push"
            else:
                continue
            if start > initial and not seen & {kind, "pick"}:
                onsets.append(Onset(kind, int(start), (None, body), grasping if kind == "pick" else touching))
            seen.add(kind)
    return onsets, grasped


def _displacement(rows: ReplayContacts, motion: BodyPoses, body: int) -> float:
    """Return how far a contact with an object displaces a touched point of it from where it is at first [m].

    Args:
        rows: The contact, with the object as its second body.
        motion: Poses at every step.
        body: The object.
    """
    if not len(rows.step):
        return 0.0
    first, last = int(rows.step.min()), int(rows.step.max())
    local = motion.into(body, rows.step, rows.point)
    corners = np.unique(np.concatenate([local.argmin(axis=0), local.argmax(axis=0)]))
    position, rotation = motion.position[first : last + 1, body], motion.rotation[first : last + 1, body]
    path = position[:, None] + np.einsum("kij,cj->kci", rotation, local[corners])
    return float(np.linalg.norm(path - path[0], axis=2).max())


def forces_cancel(rows: ReplayContacts, steps: int, width: int, share: float) -> np.ndarray:
    """Return when normal forces cancel to less than `share` of their sum, over windows of `width` steps, shape (K,).

    Adhesion is a force against the pressure of its contact.
    """
    total = np.zeros((steps, 4))
    net = (rows.force - rows.pull)[:, None] * rows.normal
    np.add.at(total, rows.step, np.concatenate([net, (rows.force + rows.pull)[:, None]], axis=1))
    total = window_sums(total, width)
    return np.linalg.norm(total[:, :3], axis=1) < share * total[:, 3]
