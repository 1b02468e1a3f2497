"""Fixed objects that stand elsewhere in every world: the box is clamped, and its place differs from episode to episode.

MuJoCo lets no position of a static body change. A mocap body is as immovable, and its pose is part of the state.
"""

from __future__ import annotations

import mujoco

from concent_warp.scene.scene import Scene


def movable(scene: Scene) -> Scene:
    """Return a scene whose fixed objects are mocap bodies: those that are fixed to the world itself.

    Contacts with what is static are left out, as they are of a static body.
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
    """Return which mocap body of a model a body is, None of others."""
    found = int(m.body_mocapid[body])
    return None if found < 0 else found
