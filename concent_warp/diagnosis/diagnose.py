"""Which physical effect is missing: from a recording and a model to a diagnosis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.checkpoint import checkpointed_procedure
from concent_warp.diagnosis.procedure import Procedure, Progress, silent
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import versions
from concent_warp.simulate.select import EngineName


def diagnose(
    model: Model,
    recording: Recording,
    cfg: DiagnoseCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find which physical effect a model lacks to follow a recording, or why none can be named.

    Args:
        model: The model; the parameters of the effects that it has are fitted too.
        recording: What was commanded and measured.
        cfg: Settings.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device; C MuJoCo is the faster one for
            the many short simulations of a diagnosis.
        out: Folder in which finished parts are kept: the same call continues from there after an interruption.
        progress: Called with the share done, 0..1, and what is being done.

    Raises:
        RecordingError: The recording says too little, or does not fit the model.
        ModelError: The model diverges on all of the recording.
        EngineError: The model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> cfg = cw.DiagnoseCfg(effects=("joint_friction", "joint_damping"), jobs=1, explain=False)
        >>> diagnosis = cw.diagnose(cw.Model.from_recording(recording), recording, cfg)
        >>> diagnosis.verdict, diagnosis.groups
        ('effect', (('joint_friction',),))
    """
    model.check_recording(recording)
    cfg, progress = cfg or DiagnoseCfg(), progress or silent
    if out is None:
        procedure = Procedure(model, recording, cfg, progress, engine)
    else:
        procedure = checkpointed_procedure(model, recording, cfg, progress, engine, Path(out))
    return replace(procedure.run(), versions=versions())
