import numpy as np

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.rollout_file import save_rollout

XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="ball" pos="0 0 .1"><freejoint/><geom name="ball" size=".1" mass="1"/></body>
  </worldbody>
  <sensor><framepos name="place" objtype="xbody" objname="ball"/></sensor>
</mujoco>
"""


def test_a_saved_rollout_reads_back_with_names_and_contact_forces(tmp_path):
    engine = MujocoEngine(Model(Scene(XML)))
    rollout = engine.run(Variants(1), np.zeros((200, 0)), contacts="all")
    path = tmp_path / "rollout.npz"
    save_rollout(rollout, engine.compiled, path)
    with np.load(path, allow_pickle=False) as data:
        assert data["time"][-1] == rollout.time[-1]
        assert list(data["bodies"]) == ["world", "ball"]
        assert np.array_equal(data["sensor/place"], data["body_position"][:, 1])
        assert set(data["contact/geom"][-1]) == {"floor", "ball"}
        assert abs(abs(data["contact/force"][-1, 2]) - 9.81) < 0.2
    assert [p.name for p in tmp_path.iterdir()] == ["rollout.npz"]
