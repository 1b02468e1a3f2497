"""Fixed objects as mocap bodies, so that their poses can differ between worlds and episodes.

MuJoCo does not let the position of a static body change; the pose of a mocap body is part of the state.
"""

from __future__ import annotations

import mujoco

from concent_warp.scene.scene import Scene


def with_movable_fixtures(scene: Scene) -> Scene:
    """Return a scene in which the objects fixed to the world are mocap bodies.

    Their contacts with static bodies are excluded, as those between static bodies are.
    """
    m, spec = scene.model, scene.spec()
    static = [b for b in range(m.nbody) if m.body_weldid[b] == 0 and m.body(b).name]
    fixed = [b for b in static if b and m.body_parentid[b] == 0 and m.body(b).name in scene.objects()]
    if not fixed:
        return scene
    pairs = {(min(a, b), max(a, b)) for a in fixed for b in static if a != b}
    excluded = {tuple(sorted((e.bodyname1, e.bodyname2))) for e in spec.excludes}
    for body in fixed:
        spec.body(m.body(body).name).mocap = True
    for a, b in sorted(pairs):
        names = m.body(a).name, m.body(b).name
        if tuple(sorted(names)) not in excluded:
            spec.add_exclude(bodyname1=names[0], bodyname2=names[1])
    return Scene.from_spec(spec, source=scene.source)


def mocap_id(m: mujoco.MjModel, body: int) -> int | None:
    """Return the mocap index of a body, None if it is no mocap body."""
    found = int(m.body_mocapid[body])
    return None if found < 0 else found
