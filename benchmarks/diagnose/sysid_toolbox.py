"""MuJoCo's system identification toolbox on our models and recordings, for `alternatives.py`.

The toolbox holds parameters, simulates, optimises and tells intervals; what it fits are the parameters of effects that
are plain fields of MuJoCo's model. Each window of the recording is a sequence of its own, from the measured initial
state. The residual is measured less predicted over noise. Its rollouts give sensor readings the time of the state after
a step, while MuJoCo computes them before it: they are read one time step earlier here, in the toolbox's favour.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from benchmarks.diagnose.fit_everything import Blame, blamed
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction, SensorReader
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.replay import commands

PLAIN = (
    "joint_friction",
    "joint_damping",
    "armature",
    "actuator_gain",
    "mass",
    "inertia",
    "sliding_friction",
    "torsional_friction",
    "rolling_friction",
    "contact_compliance",
)
"""What a user of the toolbox would fit: numbers of joints, drives, bodies and contacts."""
ITERATIONS = 40
STEP = 1e-4
"""Step of finite differences: contacts make motion jump a little, which the toolbox's default of 1e-8 would measure."""


def fit_toolbox(model: Model, recording: Recording) -> tuple[Model, list[Blame]]:
    """Fit the plain numbers of a model; return it and those that are off what they were."""
    try:
        from mujoco import sysid

        optimize = sysid.optimize
    except (ImportError, AttributeError):
        raise SystemExit('mujoco.sysid lacks packages: pip install "mujoco[sysid]"') from None
    effects = candidates(model, {c for d in recording.demonstrations for c in d.measured}, PLAIN)
    windows = observe(model, recording)
    prediction = Prediction(model, effects, windows, threads=1)
    params = sysid.ParameterDict()
    for k, p in enumerate(prediction.parameters):
        params.add(sysid.Parameter(f"{k} {p.name}", prediction.start[k], p.low, p.high))

    def build(parameters: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
        del spec
        return prediction.model(parameters.as_vector()).compile()

    spec = prediction.model(prediction.start).spec()
    pieces = [
        sysid.build_residual_fn(
            models_sequences=[sequence(sysid, spec, build, window, k)],
            build_model=build,
            modify_residual=residual_of(prediction, k),
            n_threads=1,
        )
        for k, window in enumerate(windows)
    ]

    def residual(x: np.ndarray, parameters: Any) -> tuple[list[np.ndarray], None, None]:
        return [r for piece in pieces for r in piece(x, parameters)[0]], None, None

    scale = np.array([p.scale for p in prediction.parameters])
    with contextlib.redirect_stdout(io.StringIO()):
        fitted, result = optimize(
            params.move_off_bounds(),
            residual,
            optimizer="mujoco",
            verbose=False,
            max_iters=ITERATIONS,
            x_scale=scale,
            eps=STEP,
        )
    values = fitted.as_vector()
    _, reach = sysid.calculate_intervals(residual(values, fitted.copy())[0], np.asarray(result.jac))
    return prediction.model(values), blamed(
        prediction.effects, prediction.split, prediction.parameters, values, reach / 1.96, prediction.owned
    )


def sequence(sysid: Any, spec: mujoco.MjSpec, build: Any, window: Window, number: int) -> Any:
    """Return a window as the toolbox holds it; what was measured is compared by `residual_of`."""
    del build
    m = spec.compile()
    steps = int(np.ceil((window.end - window.start) / m.opt.timestep - 1e-9)) + 2
    time = np.arange(steps) * m.opt.timestep
    ctrl = commands(m, window.demonstration, steps, window.start)
    blank = sysid.TimeSeries.from_names(time, np.zeros((steps, m.nsensordata)), m)
    start = sysid.create_initial_state(m, window.qpos, window.qvel, np.zeros(m.na))
    return sysid.ModelSequences(
        "model", spec, f"window {number}", start, sysid.TimeSeries.from_control_names(time, ctrl, m), blank
    )


def residual_of(prediction: Prediction, number: int) -> Callable[..., tuple[np.ndarray, Any, Any]]:
    """Return the toolbox's hook that compares a window."""

    def compare(
        params: Any, predicted: Any, measured: Any, model: mujoco.MjModel, return_all: bool, **_: Any
    ) -> tuple[np.ndarray, Any, Any]:
        del params, return_all
        reader = SensorReader(model, predicted.times - model.opt.timestep, predicted.data)
        return prediction.observed(number, reader, prediction.start), measured, measured

    return compare
