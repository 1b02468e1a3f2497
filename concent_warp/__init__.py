"""ConCent-Warp: contact-centric real-to-sim-to-real learning from one demonstration.

The names below are the public interface; each is imported when it is first used, so that ``import concent_warp`` takes
milliseconds. Functions take data first, then `cfg`, their settings, then keywords only: `engine`, where to write
(`out`), and `progress`.
"""

from __future__ import annotations

import sys
from importlib import import_module
from inspect import Signature, signature
from types import ModuleType
from typing import TYPE_CHECKING, Any

from concent_warp.version import __version__

_HOMES = {
    "comparison.compare": ("CompareCfg", "compare"),
    "comparison.result": ("Comparison",),
    "deploy.cfg": ("EvaluateCfg", "HandoverCfg", "PlayCfg", "RenderCfg"),
    "deploy.distil": ("distil",),
    "deploy.evaluate": ("evaluate",),
    "deploy.explain.cfg": ("ExplainCfg",),
    "deploy.explain.explain": ("explain",),
    "deploy.explain.page": ("write_explanation",),
    "deploy.explain.result": ("Explanation", "TrialExplanation"),
    "deploy.improve.cfg": ("ImproveCfg",),
    "deploy.improve.improve": ("improve",),
    "deploy.improve.rounds": ("Improved", "MissingEffect", "ImprovementRound"),
    "deploy.play": ("play",),
    "deploy.render_dataset": ("Dataset", "render"),
    "deploy.trial_environment": ("TrialEnvironment", "TrialObservation", "TrialStep"),
    "diagnosis.cfg": ("DiagnoseCfg",),
    "diagnosis.diagnose": ("diagnose",),
    "diagnosis.forces.locate": ("locate_forces",),
    "diagnosis.experiment.cfg": ("SuggestExperimentCfg",),
    "diagnosis.experiment.suggest": ("suggest_experiment",),
    "diagnosis.experiment.suggested": ("SuggestedExperiment",),
    "diagnosis.forces.cfg": ("LocateForcesCfg",),
    "diagnosis.result": ("Diagnosis", "Finding"),
    "diagnosis.suggestion.cfg": ("MotionLimitsCfg", "SuggestCfg"),
    "diagnosis.suggestion.suggest": ("suggest",),
    "diagnosis.suggestion.suggestion": ("Suggestion",),
    "effects.effect": ("Effect", "Parameter"),
    "effects.registry": ("effect_class", "effect_classes"),
    "errors": (
        *("ConcentError", "EngineError", "EventsError", "ModelError", "RecordingError"),
        *("RenderError", "SceneError", "TrainError"),
    ),
    "events.cfg": ("StagingCfg",),
    "events.extract_events": ("extract_events",),
    "events.sequence": ("ContactEvent", "ContactEventSequence", "Stage"),
    "examples": ("example",),
    "fit.effects.fit": ("FitEffectsCfg", "FittedEffects", "fit_effects"),
    "fit.fit_geometry": ("FitCfg", "fit_geometry"),
    "fit.geometry.search": ("FitResult",),
    "ground": ("GroundCfg", "Grounded", "ground"),
    "model": ("Model", "load_model"),
    "perception.backends.cfg": (
        *("DepthMaskerCfg", "FeatureTrackerCfg", "FlowTrackerCfg"),
        *("Sam2MaskerCfg", "TapirTrackerCfg"),
    ),
    "perception.backends.depth": ("DepthMasker",),
    "perception.backends.features": ("FeatureTracker",),
    "perception.backends.flow": ("FlowTracker",),
    "perception.backends.protocols": ("CameraFrames", "MaskPrompt", "Masker", "PixelTracks", "PointTracker"),
    "perception.backends.sam2": ("Sam2Masker",),
    "perception.backends.tapir": ("TapirTracker",),
    "perception.calibration.calibrate": ("calibrate",),
    "perception.calibration.cfg": ("CalibrateCfg", "CalibrationTargetCfg"),
    "perception.calibration.result": ("Calibration", "CameraCalibration"),
    "perception.tracking.cfg": ("TrackCfg",),
    "perception.tracking.pose_tracker": ("ModelToFrameTracker", "PointPoseTracker", "PoseTracker", "TrackingInput"),
    "perception.tracking.result": ("BodyTrack", "Tracked", "TrackQuality"),
    "perception.tracking.track": ("track",),
    "recording.formats.hdf5": ("write_hdf5",),
    "recording.load": ("load_recording",),
    "recording.logs.cfg": ("ImportCfg",),
    "recording.logs.import_log": ("import_log",),
    "recording.recording": ("Channel", "Demonstration", "PointTrack", "PolicyLog", "Recording"),
    "render.dataset.from_recording": ("WriteLeRobotCfg", "write_lerobot"),
    "report.cfg": ("ReportCfg",),
    "report.report": ("write_report",),
    "report.tracking.cfg": ("LiveTrackCfg", "TrackReportCfg"),
    "report.tracking.report": ("write_track_report",),
    "scene.payloads": ("Payload",),
    "scene.scene": ("Scene",),
    "scene.spheres.build": ("ContactGeometryCfg",),
    "scene.spheres.contact_geometry": ("ContactGeometry",),
    "simulate.engine": ("Rollout",),
    "simulate.replay_recording": ("replay",),
    "train.cfg": ("EnvironmentCfg", "PpoCfg", "TrainCfg"),
    "train.distil.cfg": (
        *("AugmentCfg", "DaggerCfg", "DistilCfg", "ImagesCfg"),
        *("LooksCfg", "StudentNetworkCfg"),
    ),
    "train.distil.student": ("Student", "load_student"),
    "train.flow.cfg": (
        *("FlowDataCfg", "FlowPolicyCfg"),
        *("SmallBackboneCfg", "TrainFlowCfg"),
    ),
    "train.flow.policy": ("FlowPolicy", "load_flow_policy"),
    "train.flow.task_policy": ("TaskFlowPolicy",),
    "train.flow.train_flow": ("FlowProgress", "train_flow"),
    "train.observation_cfg": ("SensorErrorsCfg",),
    "train.trials.evaluate": ("Evaluation",),
    "train.policy.load": ("Policy", "load_policy"),
    "train.train": ("train",),
}
"""Public names by the module that defines them."""
_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_MODULE_OF)]  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from concent_warp.comparison.compare import CompareCfg, compare
    from concent_warp.comparison.result import Comparison
    from concent_warp.deploy.cfg import EvaluateCfg, HandoverCfg, PlayCfg, RenderCfg
    from concent_warp.deploy.distil import distil
    from concent_warp.deploy.evaluate import evaluate
    from concent_warp.deploy.explain.cfg import ExplainCfg
    from concent_warp.deploy.explain.explain import explain
    from concent_warp.deploy.explain.page import write_explanation
    from concent_warp.deploy.explain.result import Explanation, TrialExplanation
    from concent_warp.deploy.improve.cfg import ImproveCfg
    from concent_warp.deploy.improve.improve import improve
    from concent_warp.deploy.improve.rounds import Improved, ImprovementRound, MissingEffect
    from concent_warp.deploy.play import play
    from concent_warp.deploy.render_dataset import Dataset, render
    from concent_warp.deploy.trial_environment import TrialEnvironment, TrialObservation, TrialStep
    from concent_warp.diagnosis.cfg import DiagnoseCfg
    from concent_warp.diagnosis.diagnose import diagnose
    from concent_warp.diagnosis.experiment.cfg import SuggestExperimentCfg
    from concent_warp.diagnosis.experiment.suggest import suggest_experiment
    from concent_warp.diagnosis.experiment.suggested import SuggestedExperiment
    from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
    from concent_warp.diagnosis.forces.locate import locate_forces
    from concent_warp.diagnosis.result import Diagnosis, Finding
    from concent_warp.diagnosis.suggestion.cfg import MotionLimitsCfg, SuggestCfg
    from concent_warp.diagnosis.suggestion.suggest import suggest
    from concent_warp.diagnosis.suggestion.suggestion import Suggestion
    from concent_warp.effects.effect import Effect, Parameter
    from concent_warp.effects.registry import effect_class, effect_classes
    from concent_warp.errors import (
        ConcentError,
        EngineError,
        EventsError,
        ModelError,
        RecordingError,
        RenderError,
        SceneError,
        TrainError,
    )
    from concent_warp.events.cfg import StagingCfg
    from concent_warp.events.extract_events import extract_events
    from concent_warp.events.sequence import ContactEvent, ContactEventSequence, Stage
    from concent_warp.examples import example
    from concent_warp.fit.effects.fit import FitEffectsCfg, FittedEffects, fit_effects
    from concent_warp.fit.fit_geometry import FitCfg, fit_geometry
    from concent_warp.fit.geometry.search import FitResult
    from concent_warp.ground import GroundCfg, Grounded, ground
    from concent_warp.model import Model, load_model
    from concent_warp.perception.backends.cfg import (
        DepthMaskerCfg,
        FeatureTrackerCfg,
        FlowTrackerCfg,
        Sam2MaskerCfg,
        TapirTrackerCfg,
    )
    from concent_warp.perception.backends.depth import DepthMasker
    from concent_warp.perception.backends.features import FeatureTracker
    from concent_warp.perception.backends.flow import FlowTracker
    from concent_warp.perception.backends.protocols import CameraFrames, Masker, MaskPrompt, PixelTracks, PointTracker
    from concent_warp.perception.backends.sam2 import Sam2Masker
    from concent_warp.perception.backends.tapir import TapirTracker
    from concent_warp.perception.calibration.calibrate import calibrate
    from concent_warp.perception.calibration.cfg import CalibrateCfg, CalibrationTargetCfg
    from concent_warp.perception.calibration.result import Calibration, CameraCalibration
    from concent_warp.perception.tracking.cfg import TrackCfg
    from concent_warp.perception.tracking.pose_tracker import (
        ModelToFrameTracker,
        PointPoseTracker,
        PoseTracker,
        TrackingInput,
    )
    from concent_warp.perception.tracking.result import BodyTrack, Tracked, TrackQuality
    from concent_warp.perception.tracking.track import track
    from concent_warp.recording.formats.hdf5 import write_hdf5
    from concent_warp.recording.load import load_recording
    from concent_warp.recording.logs.cfg import ImportCfg
    from concent_warp.recording.logs.import_log import import_log
    from concent_warp.recording.recording import Channel, Demonstration, PointTrack, PolicyLog, Recording
    from concent_warp.render.dataset.from_recording import WriteLeRobotCfg, write_lerobot
    from concent_warp.report.cfg import ReportCfg
    from concent_warp.report.report import write_report
    from concent_warp.report.tracking.cfg import LiveTrackCfg, TrackReportCfg
    from concent_warp.report.tracking.report import write_track_report
    from concent_warp.scene.payloads import Payload
    from concent_warp.scene.scene import Scene
    from concent_warp.scene.spheres.build import ContactGeometryCfg
    from concent_warp.scene.spheres.contact_geometry import ContactGeometry
    from concent_warp.simulate.engine import Rollout
    from concent_warp.simulate.replay_recording import replay
    from concent_warp.train.cfg import EnvironmentCfg, PpoCfg, TrainCfg
    from concent_warp.train.distil.cfg import (
        AugmentCfg,
        DaggerCfg,
        DistilCfg,
        ImagesCfg,
        LooksCfg,
        StudentNetworkCfg,
    )
    from concent_warp.train.distil.student import Student, load_student
    from concent_warp.train.flow.cfg import (
        FlowDataCfg,
        FlowPolicyCfg,
        SmallBackboneCfg,
        TrainFlowCfg,
    )
    from concent_warp.train.flow.policy import FlowPolicy, load_flow_policy
    from concent_warp.train.flow.task_policy import TaskFlowPolicy
    from concent_warp.train.flow.train_flow import FlowProgress, train_flow
    from concent_warp.train.observation_cfg import SensorErrorsCfg
    from concent_warp.train.policy.load import Policy, load_policy
    from concent_warp.train.train import train
    from concent_warp.train.trials.evaluate import Evaluation


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _ROOMS:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_MODULE_OF]


_ROOMS = ("ground", "render", "train")
"""Functions that share their name with a module or a sub-package."""


class _Room(ModuleType):
    """A module that is called as the function of its name: ``concent_warp.train(...)``."""

    @property
    def _function(self) -> Any:
        name = self.__name__.rpartition(".")[2]
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)

    @property
    def __signature__(self) -> Signature:
        return signature(self._function)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._function(*args, **kwargs)


class _FrontDoor(ModuleType):
    """This module: what is imported under the name of a function can be called as that function."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _ROOMS and isinstance(value, ModuleType):
            value.__class__ = _Room
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _FrontDoor
