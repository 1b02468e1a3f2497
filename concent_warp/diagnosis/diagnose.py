"""Which physical effect is missing: from a recording and a model to a diagnosis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from concent_warp.checks import check_settings
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.checkpoint import checkpointed_runner
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.diagnosis.tasks import Progress, TaskRunner, ignore_progress
from concent_warp.files import write_json
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import lock_folder, versions
from concent_warp.simulate.select import EngineName

DIAGNOSIS_FILE = "diagnosis.json"
"""File of the diagnosis, as `Diagnosis.to_json` returns it, in the output folder."""
EXPERIMENT_FILE = "next_experiment.json"
"""File of the suggested experiment in the output folder."""


def diagnose(
    model: Model,
    recording: Recording,
    cfg: DiagnoseCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Return which physical effect a model lacks to follow a recording, or why none can be named.

    Args:
        model: The model; the parameters of its effects are fitted too.
        recording: What was commanded and measured.
        cfg: Settings.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device; C MuJoCo is the faster one for
            the many short simulations of a diagnosis.
        out: Folder for finished tasks, from which the same call continues after an interruption, for the diagnosis,
            ``diagnosis.json``, and for the suggested experiment with its arrays, ``next_experiment.json``.
        progress: Called with the share done, 0..1, and what is being done.

    Raises:
        RecordingError: The recording has too few readings, or does not match the model.
        ModelError: The model diverges on all of the recording.
        EngineError: The model cannot be simulated.
        ConcentError: Another process writes to `out`.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> cfg = cw.DiagnoseCfg(effects=("joint_friction", "joint_damping"), jobs=1, explain=False)
        >>> diagnosis = cw.diagnose(cw.Model.from_recording(recording), recording, cfg)
        >>> diagnosis.verdict, diagnosis.groups
        ('effect', (('joint_friction',),))
    """
    check_inputs(model, recording)
    cfg, progress = cfg or DiagnoseCfg(), progress or ignore_progress
    check_settings(cfg)
    if out is None:
        return _diagnosed(model, recording, cfg, TaskRunner(cfg.jobs, progress), engine)
    with lock_folder(Path(out)):
        runner = checkpointed_runner(model, recording, cfg, progress, engine, Path(out))
        found = _diagnosed(model, recording, cfg, runner, engine)
        write_json(Path(out) / DIAGNOSIS_FILE, found.to_json())
        if found.next_experiment is not None:
            write_json(Path(out) / EXPERIMENT_FILE, found.next_experiment.to_json())
    return found


def _diagnosed(
    model: Model, recording: Recording, cfg: DiagnoseCfg, runner: TaskRunner, engine: EngineName
) -> Diagnosis:
    """Return the diagnosis by the tasks of a runner."""
    return replace(Procedure(model, recording, cfg, runner, engine).run(), versions=versions())
