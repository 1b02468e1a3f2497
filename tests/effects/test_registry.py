import sys
from pathlib import Path

import pytest

from concent_warp.effects.catalogue import _catalogue
from concent_warp.effects.registry import effect_classes
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.shape_sorter import ShapeSorterCfg

OWN = """
from concent_warp.effects.library.joints import JointEffect, JointDamping

class CableSpring(JointEffect):
    name, summary, source, signature = "cable_spring", "tau = -k q", "Hooke", "torque in proportion to position"

    def parameters(self, m):
        rest = m.jnt_stiffness[self.ids(m)]
        return self.parameter_per_target("stiffness", "N m/rad", rest, low=0.0, high=9.0, scale=0.5)

    def fields(self, m):
        return ("jnt_stiffness",)

    def write(self, m, values):
        m.jnt_stiffness[self.ids(m)] = values

class Taken(JointDamping):
    pass

number = 3
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that installs a package whose entry point names something of it."""

    def install_package(what: str) -> None:
        info = tmp_path / "own_effects-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-effects\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[concent_warp.effects]\nown = own_effects:{what}\n")
        (tmp_path / "own_effects.py").write_text(OWN)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "own_effects", raising=False)
        effect_classes.cache_clear()

    yield install_package
    effect_classes.cache_clear()


def test_effect_of_an_installed_package_is_added_saved_and_loaded(install, tmp_path):
    install("CableSpring")
    model = Model(ShapeSorterCfg().build()).add(effect_classes()["cable_spring"]("joint4"), [0.8])
    model.save(tmp_path / "model.toml")
    loaded = Model.load(tmp_path / "model.toml").compile()
    assert loaded.jnt_stiffness[loaded.joint("joint4").id] == 0.8


@pytest.mark.parametrize(
    ("what", "words"), [("number", "not an effect"), ("Taken", "taken"), ("Missing", "cannot be imported")]
)
def test_entry_point_that_cannot_be_used_is_named(install, what, words):
    install(what)
    with pytest.raises(ModelError, match=words) as raised:
        effect_classes()
    assert f"own_effects:{what}" in str(raised.value)


def test_documentation_lists_the_effects_as_they_are():
    page = (Path(__file__).parents[2] / "docs" / "effects.md").read_text()
    begin, end = "python -m concent_warp.effects.catalogue` -->\n", "<!-- end of effects -->"
    listed = page[page.index(begin) + len(begin) : page.index(end)]
    assert listed == _catalogue()
