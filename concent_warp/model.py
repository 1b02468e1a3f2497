"""Model of a simulation: scene, contact geometry and effects, stored as ``model.toml`` with files beside it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from concent_warp.documents import is_number, read_toml
from concent_warp.effects.effect import AddedEffect, Effect, prepare, write
from concent_warp.effects.registry import effect_class
from concent_warp.effects.table import checked_values, effects_table, posteriors_table, read_effects, with_posteriors
from concent_warp.errors import ModelError
from concent_warp.files import all_or_none, write_text
from concent_warp.recording.recording import Recording
from concent_warp.recording.validation.location import ErrorLocation
from concent_warp.recording.validation.scene_text import check_is_mjcf
from concent_warp.recording.validation.validate import check_contents, check_is_recording
from concent_warp.scene.payloads import Payload, scene_with_payloads
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.objects import load_object
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

FORMAT = "concent-model"
VERSION = 1


@dataclass(frozen=True)
class ContactParameters:
    """MuJoCo's contact parameters of the spheres."""

    solref: tuple[float, float] = (0.005, 1.0)
    """Time constant [s] and damping ratio [-]."""
    solimp: tuple[float, float, float] = (0.9, 0.95, 0.001)
    """Impedance at zero depth, at full depth [-], and the depth between them [m]."""
    condim: int = 4
    """Contact dimensionality: 3 sliding friction, 4 torsional too, 6 rolling too."""

    def __post_init__(self) -> None:
        (first, second), (shallow, deep, width) = self.solref, self.solimp
        if not np.isfinite([*self.solref, *self.solimp]).all():
            raise ModelError("[contact] holds a number that is not finite", found=[*self.solref, *self.solimp])
        if not ((first > 0 and second > 0) or (first <= 0 and second <= 0)):
            raise ModelError(
                "[contact] solref is not right",
                expected="a time constant and a damping ratio above 0, or stiffness and damping both with a minus sign",
                found=list(self.solref),
            )
        if not (0 <= shallow <= deep <= 1 and width >= 0):
            raise ModelError(
                "[contact] solimp is not right",
                expected="0 <= impedance at zero depth <= impedance at full depth <= 1, and a depth >= 0",
                found=list(self.solimp),
            )


@dataclass(frozen=True)
class Model:
    """Scene, contact geometry, contact parameters and effects.

    Time step, integrator and solver are those of the scene's MJCF.

    Example:
        >>> import concent_warp as cw
        >>> model = cw.Model.from_recording(cw.load_recording(cw.example("servo")))
        >>> model.add_effect("joint_friction", values={"torque[hinge]": 0.03}).effects[0].values
        (0.03,)
    """

    scene: Scene
    geometry: ContactGeometry | None = None
    contact: ContactParameters = field(default_factory=ContactParameters)
    effects: tuple[AddedEffect, ...] = ()
    """Physical effects with the values of their parameters, in the order in which they were added."""

    @staticmethod
    def from_recording(recording: Recording) -> Model:
        """Return the model of a recording's scene, without contact geometry and effects.

        Raises:
            RecordingError: This is not a recording, or its scene is not MJCF text.
        """
        check_is_recording(recording)
        check_is_mjcf(recording.scene, ErrorLocation(recording.source, channel="scene"))
        return Model(Scene(recording.scene, source=recording.source))

    def spec(self, collidable: np.ndarray | None = None) -> mujoco.MjSpec:
        """Return a fresh spec with the spheres attached, prepared for the effects; `finish` what is compiled from it.

        `collidable`, shape (S,) bool, leaves out the spheres that are False (paper, section 3.2.2).
        """
        spec = self.scene.spec()
        if self.geometry is not None:
            self.geometry.attach(spec, collidable=collidable, **asdict(self.contact))
        prepare(spec, self.effects)
        return spec

    def finish(self, m: mujoco.MjModel) -> mujoco.MjModel:
        """Set the effects' fields of a model compiled from `spec`, in place, and return it."""
        if self.effects:
            write(m, self.effects)
            mujoco.mj_setConst(m, mujoco.MjData(m))
        return m

    def compile(self, collidable: np.ndarray | None = None) -> mujoco.MjModel:
        """Return the compiled model, see `spec`."""
        return self.finish(self.spec(collidable).compile())

    def with_geometry(self, geometry: ContactGeometry | None) -> Model:
        """Return a copy with another contact geometry."""
        return replace(self, geometry=geometry)

    def with_payloads(self, payloads: Sequence[Payload]) -> Model:
        """Return the model of a demonstration in which bodies carried payloads, the same one where there are none."""
        return replace(self, scene=scene_with_payloads(self.scene, tuple(payloads))) if payloads else self

    def add(self, effect: Effect, values: Mapping[str, float] | Sequence[float] | None = None) -> Model:
        """Return a copy with one more effect.

        Args:
            effect: The effect, on what it acts.
            values: Values of its parameters, by name or in their order; those not named keep the null value, at which
                the effect does nothing.

        Raises:
            ModelError: A target or a parameter does not exist, a value is out of bounds, or the model has it already.
        """
        base = self.compile()
        effect.check(base)
        same = (a.effect.elements for a in self.effects if a.effect.name == effect.name)
        if any(set(names) & set(effect.elements) or names == effect.elements for names in same):
            raise ModelError(f"the model already has {effect.name} on a target", found=list(effect.target))
        added = AddedEffect(effect, checked_values(effect, base, values))
        return replace(self, effects=(*self.effects, added))

    def add_effect(self, name: str, target: Sequence[str] = (), values: Mapping[str, float] | None = None) -> Model:
        """Return a copy with one more effect, by its name in the library.

        Args:
            name: Name of the effect; `concent_warp.effect_classes()` lists them.
            target: Joints, tendons, actuators, bodies or sensors that it acts on; by default all that it may act on.
            values: Values of its parameters by name, such as ``{"torque[joint1]": 0.1}``; those not named keep the
                null value, at which the effect does nothing.

        Raises:
            ModelError: There is no such effect, target or parameter, a value is out of bounds, or the model has the
                effect already.
        """
        kind, base, model = effect_class(name), self.compile(), self
        chosen = [kind(*target)] if target else [kind(*names) for names in kind.targets(base)]
        if not chosen:
            expected = "the world" if kind.kind == "none" else f"a suitable {kind.kind}"
            raise ModelError(f"there is nothing for {name} to act on", where=self.scene.source, expected=expected)
        known: list[str] = []
        for effect in chosen:
            effect.check(base)
            mine = [set(a.effect.elements) for a in model.effects[len(self.effects) :]]
            if not target and any(names & set(effect.elements) for names in mine):
                continue  # another part of the same element
            names = [p.name for p in effect.parameters(base)]
            known += names
            model = model.add(effect, {one: value for one, value in (values or {}).items() if one in names})
        for wrong in set(values or {}) - set(known):
            near = difflib.get_close_matches(wrong, known, n=1)
            fix = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(known)}"
            raise ModelError(f"{name} has no parameter {wrong!r} here", fix=fix)
        return model

    def check_recording(self, recording: Recording) -> None:
        """Check that a recording is consistent, fits its own scene, and can be of this model.

        Raises:
            RecordingError: The recording contradicts itself or its scene; with demonstration, channel and row.
            ModelError: Other actuators were commanded than the model has, or the initial state has another number of
                positions.
        """
        check_is_recording(recording)
        compiled = self.scene.model
        check_contents(recording, compiled if recording.scene == self.scene.xml else None)
        actuators = sorted(compiled.actuator(i).name for i in range(compiled.nu))
        for demonstration in recording.demonstrations:
            commanded = sorted(demonstration.action)
            if commanded != actuators:
                raise self._refusal(recording, f"actuators {actuators}", commanded)
            if demonstration.qpos is not None and len(demonstration.qpos) != compiled.nq:
                raise self._refusal(recording, f"{compiled.nq} positions in the state", len(demonstration.qpos))

    def _refusal(self, recording: Recording, has: str, found: object) -> ModelError:
        """Return the error that says what the model has and what was found in the recording instead."""
        return ModelError(
            f"the model is of another robot or scene than the recording {recording.source}",
            where=self.scene.source,
            expected=f"{has} as in the model",
            found=f"{found} in the recording",
            fix="give a model made from this recording's scene",
        )

    def without(self, index: int) -> Model:
        """Return a copy without the effect at a position of `effects`."""
        return replace(self, effects=tuple(a for i, a in enumerate(self.effects) if i != index))

    def save(self, path: str | Path) -> None:
        """Write `path` (``.toml``), the scene as ``.xml`` and the geometry as ``.npz`` beside it.

        All files are replaced, the ``.toml`` last, or none.
        """
        import tomli_w

        path = Path(path)
        document: dict[str, Any] = {"format": FORMAT, "version": VERSION}
        document["scene"] = f"{path.stem}.scene.xml"
        if self.geometry is not None:
            document["geometry"] = f"{path.stem}.geometry.npz"
        if self.geometry is not None or self.contact != ContactParameters():  # they are those of spheres
            contact = asdict(self.contact).items()
            document["contact"] = {name: list(v) if isinstance(v, tuple) else v for name, v in contact}
        if self.effects:
            document["effect"] = effects_table(self.effects)
        if posteriors := posteriors_table(self.effects):
            document["posterior"] = posteriors
        with all_or_none():
            write_text(path.with_name(document["scene"]), self.scene.xml)
            if self.geometry is not None:
                self.geometry.save(path.with_name(document["geometry"]))
            write_text(path, tomli_w.dumps(document))

    @staticmethod
    def load(path: str | Path) -> Model:
        """Read a ``model.toml``, or a plain MJCF (``.xml``) as a model without contact geometry.

        Raises `ModelError` or `SceneError` with one sentence that says what is wrong.
        """
        path = Path(path)
        if path.suffix == ".xml":
            return Model(Scene.from_mjcf(path))
        if not path.is_file():
            raise ModelError("no such model", where=path, expected="a model.toml or an MJCF .xml")
        document = read_toml(path, ModelError)
        if document.get("format") != FORMAT:
            raise ModelError(
                "not a concent model", where=path, expected=f'format = "{FORMAT}"', found=document.get("format")
            )
        if document.get("version") != VERSION:
            raise ModelError(
                "unknown version of the model file", where=path, expected=VERSION, found=document.get("version")
            )
        known = {"format", "version", "scene", "geometry", "contact", "effect", "posterior"}
        if unknown := sorted(set(document) - known):
            raise ModelError(
                "unknown entries in the model file", where=path, expected=f"only {sorted(known)}", found=unknown
            )
        if not isinstance(document.get("scene"), str):
            raise ModelError(
                "the model file names no scene", where=path, expected='scene = "file.xml"', found=document.get("scene")
            )
        if not isinstance(document.get("geometry", ""), str):
            raise ModelError("the geometry has no file name", where=path, expected='geometry = "file.npz"')
        scene = Scene.from_mjcf(path.parent / document["scene"])
        geometry = ContactGeometry.load(path.parent / document["geometry"]) if "geometry" in document else None
        model = Model(scene, geometry, _contact_parameters(document.get("contact", {}), path))
        if geometry is not None:
            missing = [b for b in geometry.bodies if mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_BODY, b) < 0]
            if missing:
                raise ModelError("the contact geometry names bodies that the scene lacks", where=path, found=missing)
        for added in read_effects(document.get("effect", []), path):
            model = replace(model.add(added.effect, added.values), effects=(*model.effects, added))
        return replace(model, effects=tuple(with_posteriors(model.effects, document.get("posterior", []), path)))


def _contact_parameters(table: Mapping[str, Any], path: Path) -> ContactParameters:
    """Read the ``[contact]`` table of a model file, strictly."""
    if not isinstance(table, Mapping):
        raise ModelError("[contact] is not a table", where=path, found=table)
    known = {f.name: f for f in fields(ContactParameters)}
    if unknown := sorted(set(table) - set(known)):
        raise ModelError("unknown entries in [contact]", where=path, expected=f"only {sorted(known)}", found=unknown)
    values: dict[str, Any] = {}
    for name, value in table.items():
        default = getattr(ContactParameters(), name)
        if isinstance(default, tuple):
            numbers = isinstance(value, list) and all(map(is_number, value))
            if not numbers or len(value) != len(default):
                raise ModelError(
                    f"[contact] {name} is not right", where=path, expected=f"{len(default)} finite numbers", found=value
                )
            values[name] = tuple(float(v) for v in value)
        elif not isinstance(value, int) or value not in (3, 4, 6):
            raise ModelError(f"[contact] {name} is not right", where=path, expected="3, 4 or 6", found=value)
        else:
            values[name] = value
    try:
        return ContactParameters(**values)
    except ModelError as error:
        raise ModelError(str(error).rstrip("."), where=path) from None


def load_model(path: str | Path) -> Model:
    """Read a ``model.toml`` as `Model.save` writes it, or an MJCF (``.xml``) as a model without contact geometry.

    Raises:
        ModelError: The file is missing, damaged or of another version.
        SceneError: MuJoCo cannot compile the scene.

    Example:
        >>> import concent_warp as cw
        >>> cw.Model.from_recording(cw.load_recording(cw.example("servo"))).save("model.toml")
        >>> cw.load_model("model.toml").effects
        ()
    """
    return Model.load(path)


def model_with_spheres(
    source: Path,
    cfg: ContactGeometryCfg | None = None,
    *,
    objects: Sequence[str] = (),
    added: Mapping[str, Path] | None = None,
    scale: float = 1.0,
) -> Model:
    """Return the model of a scene with contact spheres on its objects; that of a model file as it is.

    Args:
        source: MJCF scene (.xml), recording, or model file (.toml).
        cfg: How spheres are laid.
        objects: Bodies to lay spheres on; by default those that the scene names, else those with a free joint.
        added: Files of objects that are added to the scene first, by name: meshes, point clouds or Gaussian splats.
        scale: Factor from the unit of these files to metres.

    Raises:
        ConcentError: A file cannot be read, or no spheres can be laid.
    """
    if source.suffix == ".toml":
        return Model.load(source)
    if source.suffix == ".xml":
        scene = Scene.from_mjcf(source)
    else:
        from concent_warp.recording.load import load_recording

        scene = Scene(load_recording(source).scene, source=str(source))
    surfaces = {}
    if added:
        spec = scene.spec()
        for name, file in added.items():
            found = load_object(file, name, scale=scale)
            found.add_to(spec)
            surfaces[name] = found.surface
        scene = Scene.from_spec(spec, source=scene.source)
    return Model(scene, (cfg or ContactGeometryCfg()).build(scene, objects or None, surfaces=surfaces))


def check_inputs(model: Model, recording: Recording) -> None:
    """Check what a public function was given: a model, and a recording that can be of it.

    Raises:
        ModelError: This is not a model, or it is of another robot or scene, see `Model.check_recording`.
        RecordingError: This is not a recording, or it contradicts itself.
    """
    if not isinstance(model, Model):
        path = isinstance(model, str | Path)
        raise ModelError(
            "this is not a model",
            where=model if path else None,
            expected="a Model",
            found=type(model).__name__,
            fix="read the file with load_model first" if path else None,
        )
    model.check_recording(recording)
