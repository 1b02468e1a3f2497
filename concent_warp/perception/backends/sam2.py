"""Masks by SAM 2, with the user's weights.

Ravi et al., "SAM 2: segment anything in images and videos", 2024, as the package transformers has it. Images are
prepared here as SAM 2's own code does, scaled to a square and normalised with ImageNet's mean and deviation: the
package's processors need torchvision, the model does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.checks import check_device, check_settings
from concent_warp.documents import read_json
from concent_warp.errors import ConcentError
from concent_warp.perception.backends.cfg import Sam2MaskerCfg
from concent_warp.perception.backends.protocols import CameraFrames, MaskPrompt

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of colours that the network was trained with [-]."""
INSIDE, OUTSIDE, TOP_LEFT, BOTTOM_RIGHT = 1, 0, 2, 3
"""Labels of the prompts of SAM 2."""


class Sam2Masker:
    """Masker by SAM 2.

    Needs ``pip install 'concent-warp[sam2]'`` and a folder with a checkpoint in the format of transformers
    (`config.json`, `model.safetensors`), such as a copy of `facebook/sam2.1-hiera-tiny`. Nothing is downloaded.

    Args:
        weights: The folder.
        cfg: Settings.
        device: "cpu" or "cuda:0"; the first CUDA device by default where there is one.

    Raises:
        ConcentError: The package or the checkpoint is missing, or the folder has another model.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.Sam2Masker("nowhere")
        ... except cw.ConcentError as error:
        ...     assert "nowhere" in str(error)
    """

    def __init__(self, weights: str | Path, cfg: Sam2MaskerCfg | None = None, *, device: str | None = None) -> None:
        """Load the network."""
        self.cfg = cfg or Sam2MaskerCfg()
        check_settings(self.cfg)
        check_device(device)
        self._model = _load(Path(weights))
        import torch

        self._device = torch.device(device or ("cuda:0" if torch.cuda.is_available() else "cpu"))
        self._model = self._model.to(self._device).eval()
        size = self._model.config.image_size
        self._edges = (int(size), int(size)) if isinstance(size, int) else (int(size[0]), int(size[1]))

    def masks(self, frames: CameraFrames, prompts: Mapping[str, MaskPrompt]) -> dict[str, np.ndarray]:
        """See `Masker.masks`. Objects are segmented one by one, forward and backward from their prompts."""
        import torch

        with torch.inference_mode():
            return {name: self._mask(frames, prompt) for name, prompt in prompts.items()}

    def _mask(self, frames: CameraFrames, prompt: MaskPrompt) -> np.ndarray:
        """Return the masks of one object, shape (T, H, W) bool."""
        import torch.nn.functional as functional

        result = np.zeros((frames.count, *frames.size), dtype=bool)
        for order in (range(prompt.frame, frames.count), range(prompt.frame, -1, -1)):
            if len(order) == 1 and order.step < 0:
                continue
            session = self._session(frames, prompt)
            for number, frame in enumerate(order):
                # Time runs on either way, so that memory is ordered as in training.
                found = self._model(session, frame=self._prepared(frames.rgb[frame]), frame_idx=number)
                logits = functional.interpolate(
                    found.pred_masks.float(), frames.size, mode="bilinear", align_corners=False
                )
                present = float(found.object_score_logits.reshape(-1)[0]) > self.cfg.min_presence
                result[frame] = (logits[0, 0] > self.cfg.min_logit).cpu().numpy() & present
                self._forget(session, number)
        return result

    def _session(self, frames: CameraFrames, prompt: MaskPrompt) -> Any:
        """Return a session whose first frame has the prompt."""
        import torch
        from transformers import Sam2VideoInferenceSession  # pyright: ignore

        height, width = frames.size
        session = Sam2VideoInferenceSession(
            video_height=height, video_width=width, inference_device=self._device,
            inference_state_device=self._device, video_storage_device=self._device, dtype=self._model.dtype,
        )  # fmt: skip
        box = np.zeros((0, 2)) if prompt.box is None else np.asarray(prompt.box, float).reshape(2, 2)
        pixels = np.concatenate([box, np.reshape(prompt.points, (-1, 2)), np.reshape(prompt.outside, (-1, 2))])
        labels = [TOP_LEFT, BOTTOM_RIGHT][: len(box)]
        labels += [INSIDE] * len(prompt.points) + [OUTSIDE] * len(prompt.outside)
        # The network adds the half pixel between a pixel's number and its centre itself.
        scaled = (pixels + 0.5) * [self._edges[1] / width, self._edges[0] / height] - 0.5
        number = session.obj_id_to_idx(1)
        inputs = {
            "point_coords": torch.as_tensor(scaled, dtype=torch.float32)[None, None],
            "point_labels": torch.as_tensor(labels, dtype=torch.int32)[None, None],
        }
        session.add_point_inputs(number, 0, inputs)
        session.obj_with_new_inputs = [1]
        return session

    def _prepared(self, rgb: np.ndarray) -> Any:
        """Return an image (H, W, 3) as the network takes it, shape (1, 3, h, w)."""
        import torch
        import torch.nn.functional as functional

        image = torch.as_tensor(np.ascontiguousarray(rgb), device=self._device).permute(2, 0, 1)[None].float() / 255
        image = functional.interpolate(image, self._edges, mode="bilinear", align_corners=False, antialias=True)
        mean, std = (torch.tensor(values, device=self._device).reshape(1, 3, 1, 1) for values in (MEAN, STD))
        return ((image - mean) / std).to(self._model.dtype)

    def _forget(self, session: Any, number: int) -> None:
        """Let go of what the network no longer looks at."""
        session.processed_frames.pop(number, None)
        for outputs in session.output_dict_per_obj.values():
            outputs["non_cond_frame_outputs"].pop(number - self.cfg.memory, None)


def _load(folder: Path) -> Any:
    """Return the network of a folder.

    Raises:
        ConcentError: The package or the checkpoint is missing, or it is of another network.
    """
    expected = "a checkpoint of SAM 2 in the format of transformers: config.json and model.safetensors"
    source = "such as a copy of facebook/sam2.1-hiera-tiny (Apache-2.0)"
    if not (folder / "config.json").is_file():
        found = "no such folder" if not folder.is_dir() else "no config.json"
        raise ConcentError("no weights of SAM 2", where=folder, expected=f"{expected}, {source}", found=found)
    settings = read_json(folder / "config.json")
    kind = settings.get("model_type") if isinstance(settings, dict) else type(settings).__name__
    if kind != "sam2_video":
        raise ConcentError("the weights are of another model", where=folder, expected="sam2_video", found=kind)
    try:
        from transformers import Sam2VideoModel  # pyright: ignore
        from transformers.utils import logging  # pyright: ignore
    except ImportError as error:
        fix = "pip install 'concent-warp[sam2]', or pip install 'transformers>=5.23'"
        raise ConcentError("SAM 2 needs the package transformers", found=error, fix=fix) from None
    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        options: dict[str, Any] = {"local_files_only": True, "use_safetensors": True, "output_loading_info": True}
        result: Any = Sam2VideoModel.from_pretrained(folder, **options)
        model, loaded = result
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        found = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConcentError("the weights cannot be loaded", where=folder, expected=expected, found=found) from None
    finally:
        if shown:
            logging.enable_progress_bar()
    if missing := sorted(loaded["missing_keys"]):
        found = f"no {', '.join(missing[:3])}" + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        raise ConcentError("weights are missing", where=folder, expected=expected, found=found)
    return model
