import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import pytest

from concent_warp.errors import SceneError
from concent_warp.scene import read_mjcf
from concent_warp.scene.robot import RobotCfg
from concent_warp.scene.scene import Scene

WORLD = '<worldbody><body name="ball"><freejoint/><geom size="0.1"/></body></worldbody>'


def mjcf(inside: str = "", world: str = WORLD) -> str:
    return f"<mujoco>{inside}{world}</mujoco>"


def nested(depth: int, inner: str = "") -> str:
    return '<body><geom size="0.1"/>' * depth + inner + "</body>" * depth


def read(text: str, form: str) -> Scene:
    """Compile a scene that stands in a file, or is given as text."""
    scene = Scene.from_mjcf(Path("scene.xml")) if form == "file" else Scene(text, "scene.xml")
    assert scene.model.nbody
    return scene


HOSTILE = {
    "negative time step": (mjcf('<option timestep="-1"/>'), "time step .* expected 1e-06 to 1 s, found -1"),
    "millimetres": (mjcf('<option gravity="0 0 -9810"/>'), r"gravity .* expected m/s\^2, at most 100, found 9810"),
    "time step 0": (mjcf('<option timestep="0"/>'), "time step of the scene makes no sense"),
    "time step 1e300": (mjcf('<option timestep="1e300"/>'), "time step of the scene makes no sense"),
    "time step 1e-9": (mjcf('<option timestep="1e-9"/>'), "time step of the scene makes no sense"),
    "NaN time step": (mjcf('<option timestep="nan"/>'), "time step of the scene makes no sense"),
    "NaN gravity": (mjcf('<option gravity="0 nan 0"/>'), "gravity"),
    "NaN damping": (
        mjcf(world='<worldbody><body><joint damping="nan"/><geom size="0.1"/></body></worldbody>'),
        "holds NaN in dof_damping",
    ),
    "3,000 bodies in one another": (mjcf(world=f"<worldbody>{nested(3000)}</worldbody>"), "CONCENT_MAX_SCENE_DEPTH"),
    "huge texture": (
        mjcf('<asset><texture name="t" type="2d" builtin="flat" width="60000" height="60000"/></asset>'),
        "a <texture> is too large; expected at most 67,108,864 cells, found 3,600,000,000; .*CONCENT_MAX_SCENE_CELLS",
    ),
    "huge height field": (
        mjcf('<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>'),
        "a <hfield> is too large",
    ),
    "huge user data": (mjcf('<size nuser_body="2000000000"/>'), "<size nuser_body> is too large"),
    "huge key frames": (mjcf('<size nkey="2000000000"/>'), "<size nkey> is too large"),
    "huge sensor": (mjcf('<sensor><user dim="1000000000"/></sensor>'), "<user dim> is too large"),
    "endless solver": (mjcf('<option iterations="2000000000"/>'), "<option iterations> is too large"),
    "huge arena": (mjcf('<size memory="100G"/>'), "<size memory> is too large; .*CONCENT_MAX_SCENE_ARENA_BYTES"),
    "10^10 copies": (
        mjcf(world='<worldbody><replicate count="99999"><replicate count="99999"/></replicate></worldbody>'),
        "too many copies; expected at most 100000, found 9999800001; .*CONCENT_MAX_SCENE_COPIES",
    ),
    "huge image off screen": (
        mjcf('<visual><global offwidth="1000000" offheight="1000000"/></visual>'),
        "a <global> is too large",
    ),
    "negative count": (
        mjcf(world=f'<worldbody><replicate count="-5"><body/></replicate>{WORLD[11:]}'),
        "<replicate> has a negative count; expected at least 0, found -5",
    ),
    "reversed range": (
        mjcf(world='<worldbody><body><joint range="1 -1"/><geom size="0.1"/></body></worldbody>'),
        "<joint range> is reversed; expected its lower end first, found 1 -1",
    ),
    "escape sequence": (mjcf(world=WORLD.replace("ball", "&#27;[31m")), "control character"),
    "entities": ("<!DOCTYPE x [<!ENTITY a 'b'>]>" + mjcf(), "XML entities"),
}


@pytest.mark.parametrize(("text", "message"), HOSTILE.values(), ids=HOSTILE.keys())
@pytest.mark.parametrize("form", ["file", "text"])
def test_senseless_and_endless_scenes_are_refused_at_once_and_leave_no_file(
    tmp_path, monkeypatch, capfd, text, message, form
):
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(text)
    start = time.monotonic()
    with pytest.raises(SceneError, match=message) as caught:
        read(text, form)
    assert str(caught.value).isprintable()
    assert time.monotonic() - start < 5
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"a.xml": '<mujoco><include file="a.xml"/></mujoco>'}, "<include> reads the file that it is in"),
        (
            {"a.xml": '<mujoco><include file="b.xml"/></mujoco>', "b.xml": '<mujoco><include file="a.xml"/></mujoco>'},
            "<include> reads the file that it is in; found a.xml",
        ),
        (
            {"a.xml": mjcf('<asset><model name="m" file="a.xml"/></asset>')},
            "<model> reads the file that it is in",
        ),
        (
            {
                f"{'abc'[k]}.xml": nested(300, f'<include file="{"bc"[k]}.xml"/>' if k < 2 else "").join(
                    ("<mujoco><worldbody>", "</worldbody></mujoco>")
                    if k == 0
                    else ("<mujocoinclude>", "</mujocoinclude>")
                )
                for k in range(3)
            },
            "too deep in other elements",
        ),
        ({"a.xml": mjcf('<asset><mesh name="m" file="a.3ds"/></asset>'), "a.3ds": "x"}, "a kind that is not read"),
        ({"a.xml": mjcf('<asset><mesh name="m" file="a.stl"/></asset>'), "a.stl": "x"}, "cannot be read|no triangles"),
        (
            {"a.xml": mjcf('<asset><mesh name="m" file="a.obj"/></asset>'), "a.obj": "v 0 0"},
            "cannot be read|no triangl",
        ),
        ({"a.xml": mjcf('<asset><mesh name="m" file="/dev/zero"/></asset>')}, "something that is no file"),
        ({"a.xml": mjcf('<asset><hfield name="h" file="/dev/zero" size="1 1 1 1"/></asset>')}, "that is no file"),
        ({"a.xml": '<mujoco><include file="/dev/zero"/></mujoco>'}, "includes is no file"),
    ],
)
def test_hostile_files_around_a_scene_are_refused(tmp_path, monkeypatch, files, message):
    monkeypatch.chdir(tmp_path)
    for name, text in files.items():
        Path(name).write_text(text)
    with pytest.raises(SceneError, match=message):
        Scene.from_mjcf(Path("a.xml"))


def test_a_robot_is_scanned_like_a_scene(tmp_path):
    (tmp_path / "a.xml").write_text('<mujoco><include file="a.xml"/></mujoco>')
    with pytest.raises(SceneError, match="<include> reads the file that it is in"):
        RobotCfg(tmp_path / "a.xml").build()


def test_a_picture_that_unpacks_to_gigabytes_is_refused(tmp_path):
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 6, 0, 0, 0)
    chunk = b"IHDR" + header
    (tmp_path / "t.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    )
    (tmp_path / "a.xml").write_text(mjcf('<asset><texture name="t" type="2d" file="t.png"/></asset>'))
    with pytest.raises(SceneError, match="a <texture> is too large"):
        Scene.from_mjcf(tmp_path / "a.xml")


def test_files_outside_the_folder_are_named_in_a_warning_or_refused(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "ball.xml").write_text(f"<mujocoinclude>{WORLD}</mujocoinclude>")
    (folder / "a.xml").write_text('<mujoco><include file="../ball.xml"/></mujoco>')
    with pytest.warns(UserWarning, match=r"a\.xml: the scene reads files outside its folder: \.\./ball\.xml$"):
        assert Scene.from_mjcf(folder / "a.xml").objects() == ("ball",)
    with pytest.raises(SceneError, match="reads files outside its folder"):
        Scene.from_mjcf(folder / "a.xml", warn_outside=False)


def test_an_unusual_scene_is_tried_in_a_process_with_bounds(monkeypatch):
    body = '<body><freejoint/><geom size="0.1"/></body>'
    many = mjcf(world=f'<worldbody><replicate count="60000">{body}</replicate></worldbody>')
    monkeypatch.setenv("CONCENT_MAX_SCENE_SECONDS", "1")
    with pytest.raises(SceneError, match=r"too long to compile this scene; expected at most 1 s; .*_SCENE_SECONDS"):
        assert Scene(many).model
    monkeypatch.setenv("CONCENT_MAX_SCENE_SECONDS", "60")
    monkeypatch.setenv("CONCENT_MAX_SCENE_MEMORY_BYTES", "50_000_000")
    wide = mjcf('<asset><texture name="t" type="2d" builtin="flat" width="8000" height="8000"/></asset>')
    with pytest.raises(SceneError, match=r"needs too much memory .*CONCENT_MAX_SCENE_MEMORY_BYTES"):
        assert Scene(wide).model
    monkeypatch.delenv("CONCENT_MAX_SCENE_MEMORY_BYTES")
    with pytest.raises(SceneError, match=r"MuJoCo cannot read this MJCF; found .*nothing"):
        assert Scene(mjcf('<option iterations="20000" nothing="1"/>')).model
    assert Scene(mjcf('<option iterations="20000"/>')).model.opt.iterations == 20000


def test_ordinary_scenes_are_compiled_in_this_process(monkeypatch):
    def never(*_, **__):
        raise AssertionError("tried")

    monkeypatch.setattr(read_mjcf, "try_compile", never)
    read_mjcf._check_text.cache_clear()
    assert Scene(mjcf('<option timestep="0.001"/><size memory="200M"/>')).objects() == ("ball",)


def test_a_scene_that_only_mujoco_takes_for_xml_is_still_read():
    assert Scene(mjcf("<!-- -- arms -- --->")).objects() == ("ball",)


def test_a_crash_of_mujoco_ends_the_trial_alone(tmp_path):
    """The scene that attaches itself ends a process that compiles it without a scan."""
    (tmp_path / "a.xml").write_text(
        '<mujoco><asset><model name="m" file="a.xml"/></asset>'
        '<worldbody><attach model="m" prefix="a"/></worldbody></mujoco>'
    )
    crash = "import mujoco, sys; mujoco.MjSpec.from_file(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", crash, str(tmp_path / "a.xml")], capture_output=True, check=False)
    assert done.returncode < 0
    with pytest.raises(SceneError, match="crashes when it compiles"):
        read_mjcf.try_compile("a.xml", text=None, path=_unscanned(tmp_path))


def _unscanned(folder: Path) -> Path:
    """Return a scene whose malformed comment hides from the scan that it attaches itself."""
    text = (folder / "a.xml").read_text()
    (folder / "b.xml").write_text(text.replace("<mujoco>", "<mujoco><!-- -- -->", 1).replace("a.xml", "b.xml"))
    return folder / "b.xml"


def test_the_world_is_no_object():
    text = '<mujoco><custom><text name="concent_objects" data="world"/></custom></mujoco>'
    with pytest.raises(SceneError, match="names the world"):
        Scene(text).objects()
