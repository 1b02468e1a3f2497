"""An object from a mesh file: into a scene, covered with contact spheres, dropped, and exported for plain MuJoCo.

    python examples/objects_from_mesh.py [FOLDER]

A point cloud (.ply, .xyz, .npy) or Gaussian splats (3DGS .ply) are read in the same way.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.objects import load_object
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.export import save_mjcf
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

TABLE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <light pos="0 0 1"/>
    <geom name="table" type="plane" size="1 1 0.1"/>
  </worldbody>
</mujoco>
"""


def main(folder: Path) -> None:
    """Write mesh, model and MJCF to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "ring.stl"  # in millimetres, as drawings often are
    trimesh.creation.annulus(r_min=15, r_max=30, height=12).export(path)

    ring = load_object(path, "ring", scale=1e-3, density=1200.0, friction=0.4)
    print(f"{ring.name}: {1e3 * ring.mass:.1f} g")
    spec = mujoco.MjSpec.from_string(TABLE)
    ring.add_to(spec, position=(0.0, 0.0, 0.05), quaternion=(0.966, 0.259, 0.0, 0.0))
    scene = Scene.from_spec(spec)

    geometry = ContactGeometryCfg(count=200, radius=0.003).build(scene, surfaces={"ring": ring.surface})
    model = Model(scene, geometry)
    model.save(folder / "model.toml")
    save_mjcf(model, folder / "ring_with_spheres.xml")

    rollout = MujocoEngine(model).run(Variants(1), np.zeros((500, 0)), bodies=["ring"], contacts="touched")
    height = rollout.body_position[0, :, 0, 2]
    print(f"falls from {1e3 * height[0]:.0f} mm to rest at {1e3 * height[-1]:.1f} mm on {len(geometry)} spheres")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/ring"))
