"""Points followed by TAPIR or BootsTAPIR, with the user's copy of the code and weights.

Doersch et al., "TAPIR: tracking any point with per-frame initialization and temporal refinement", ICCV 2023, and
"BootsTAP: bootstrapped training for tracking-any-point", 2024. The code is `tapnet/torch` of a checkout of
github.com/google-deepmind/tapnet, which is on no package index; it needs torch, dm-tree and einshape.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from concent_warp.checks import check_device, check_settings
from concent_warp.errors import ConcentError
from concent_warp.perception.backends.cfg import TapirTrackerCfg
from concent_warp.perception.backends.flow import corners
from concent_warp.perception.backends.protocols import CameraFrames, PixelTracks

FILES = ("tapir_model.py", "nets.py", "utils.py")
"""Files of `tapnet/torch` that are needed."""
MIXER = "torch_pips_mixer.linear.weight"
"""Weights whose size tells the number of levels of the correlation pyramid."""
FEATURES, NEIGHBOURHOOD = 388, 49
"""Inputs of the mixer: positions and features, and a neighbourhood of each level but two."""
CHUNK = 64
"""Points that the network follows at once."""
EXPECTED = "a checkpoint of TAPIR for torch, such as bootstapir_checkpoint_v2.pt"
"""What the weights should be, for messages."""
MULTIPLE = 8
"""Edges of the network's images are multiples of this [px]."""


class TapirTracker:
    """Point tracker by TAPIR; points are found again after they were hidden.

    Needs a checkout of github.com/google-deepmind/tapnet, whose code is run, `pip install dm-tree einshape`, and a
    checkpoint for torch, such as `bootstapir_checkpoint_v2.pt`. Nothing is downloaded.

    Args:
        checkout: Folder of the checkout, the one that has `tapnet/torch`.
        weights: File of the checkpoint.
        cfg: Settings.
        device: "cpu" or "cuda:0"; the first CUDA device by default where there is one.

    Raises:
        ConcentError: Code, a package or the checkpoint is missing, or the checkpoint is of another network.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.TapirTracker("nowhere", "bootstapir_checkpoint_v2.pt")
        ... except cw.ConcentError as error:
        ...     assert "tapnet" in str(error)
    """

    def __init__(
        self,
        checkout: str | Path,
        weights: str | Path,
        cfg: TapirTrackerCfg | None = None,
        *,
        device: str | None = None,
    ) -> None:
        """Load the network."""
        self.cfg = cfg or TapirTrackerCfg()
        check_settings(self.cfg)
        check_device(device)
        _check_files(Path(checkout), Path(weights))
        module = _code(Path(checkout))
        import torch

        self._device = torch.device(device or ("cuda:0" if torch.cuda.is_available() else "cpu"))
        self._model = _network(module, Path(weights), self.cfg).to(self._device).eval()

    def choose(self, frames: CameraFrames, frame: int, mask: np.ndarray, count: int) -> np.ndarray:
        """See `PointTracker.choose`: corners."""
        return corners(frames.rgb[frame], mask, count, self.cfg.spacing, self.cfg.quality)

    def track(self, frames: CameraFrames, queries: np.ndarray) -> PixelTracks:
        """See `PointTracker.track`."""
        import torch

        if not len(queries):
            empty = (0, frames.count)
            return PixelTracks(np.zeros((*empty, 2)), np.zeros(empty, dtype=bool))
        queries = np.asarray(queries, float)
        scale = min(1.0, self.cfg.longest_edge / max(frames.size))
        height, width = (max(1, round(edge * scale / MULTIPLE)) * MULTIPLE for edge in frames.size)
        by = np.array([width / frames.size[1], height / frames.size[0]])
        # The network's coordinates are 0 at the image's border, ours at the centre of the first pixel.
        at = np.column_stack([queries[:, 0], ((queries[:, 1:] + 0.5) * by)[:, ::-1]])
        with torch.inference_mode():
            found = self._model(
                self._prepared(frames, height, width),
                torch.as_tensor(at, dtype=torch.float32, device=self._device)[None],
                query_chunk_size=CHUNK,
            )
        seen = (1 - found["occlusion"].sigmoid()) * (1 - found["expected_dist"].sigmoid())
        pixels = found["tracks"][0].cpu().numpy().astype(float) / by - 0.5
        visible = seen[0].cpu().numpy() > self.cfg.min_visible
        rows, first = np.arange(len(queries)), queries[:, 0].astype(int)
        pixels[rows, first], visible[rows, first] = queries[:, 1:], True
        return PixelTracks(pixels, visible & np.isfinite(pixels).all(axis=2))

    def _prepared(self, frames: CameraFrames, height: int, width: int) -> Any:
        """Return the frames as the network takes them, from -1 to 1, shape (1, T, height, width, 3)."""
        import torch
        import torch.nn.functional as functional

        result = torch.empty((1, frames.count, height, width, 3), device=self._device)
        for frame in range(frames.count):
            rgb = torch.as_tensor(np.ascontiguousarray(frames.rgb[frame]), device=self._device)
            image = rgb.permute(2, 0, 1)[None].float() / 255 * 2 - 1
            image = functional.interpolate(image, (height, width), mode="bilinear", align_corners=False, antialias=True)
            result[0, frame] = image[0].permute(1, 2, 0)
        return result


def _check_files(checkout: Path, weights: Path) -> None:
    """Raise an error unless code and weights are there."""
    folder = checkout / "tapnet" / "torch"
    if missing := [name for name in FILES if not (folder / name).is_file()]:
        raise ConcentError(
            "no code of TAPIR", where=checkout, expected=f"tapnet/torch with {', '.join(FILES)}",
            found="no such folder" if not folder.is_dir() else f"no {', '.join(missing)}",
            fix="clone github.com/google-deepmind/tapnet and give its folder",
        )  # fmt: skip
    if not weights.is_file():
        raise ConcentError("no weights of TAPIR", where=weights, expected=EXPECTED, found="no such file")


def _code(checkout: Path) -> ModuleType:
    """Return the module `tapnet.torch.tapir_model` of a checkout.

    Raises:
        ConcentError: It, or a package that it needs, cannot be imported.
    """
    folder = checkout / "tapnet" / "torch"
    with _package(folder):
        try:
            return import_module("tapnet.torch.tapir_model")
        except ImportError as error:
            raise ConcentError(
                "the code of TAPIR cannot be imported", where=folder, found=error, fix="pip install dm-tree einshape"
            ) from None


@contextmanager
def _package(folder: Path) -> Iterator[None]:
    """Let `tapnet.torch` be that folder for a while.

    `tapnet/__init__.py` of some versions imports JAX's part, which is not needed; so it is passed over.
    """
    names = [name for name in sys.modules if name == "tapnet" or name.startswith("tapnet.")]
    before = {name: sys.modules.pop(name) for name in names}
    package, torch_part = ModuleType("tapnet"), ModuleType("tapnet.torch")
    package.__path__, torch_part.__path__ = [str(folder.parent)], [str(folder)]
    package.torch = torch_part  # pyright: ignore[reportAttributeAccessIssue]
    sys.modules.update({"tapnet": package, "tapnet.torch": torch_part})
    try:
        yield
    finally:
        for name in [name for name in sys.modules if name == "tapnet" or name.startswith("tapnet.")]:
            del sys.modules[name]
        sys.modules.update(before)


def _network(module: ModuleType, path: Path, cfg: TapirTrackerCfg) -> Any:
    """Return the network with its weights, of the kind that these are for.

    Raises:
        ConcentError: There are none, or they are of another network.
    """
    import torch

    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what torch raises on a file that is none of its own is not documented
        found = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConcentError("the weights cannot be read", where=path, expected=EXPECTED, found=found) from None
    if not isinstance(weights, dict) or not isinstance(weights.get(MIXER), torch.Tensor):
        found = sorted(weights)[:3] if isinstance(weights, dict) else type(weights).__name__
        raise ConcentError("the weights are of another network", where=path, expected=EXPECTED, found=found)
    levels = (int(weights[MIXER].shape[-1]) - FEATURES) // NEIGHBOURHOOD - 2
    extra = any(name.startswith("extra_convs.") for name in weights)
    # Older versions of the code know fewer options.
    options = {**({} if extra else {"extra_convs": False}), **({"use_casual_conv": True} if cfg.causal else {})}
    try:
        network = module.TAPIR(pyramid_level=levels, **options)
        network.load_state_dict(weights)
    except (RuntimeError, TypeError) as error:
        found = str(error).splitlines()[-1].strip()
        raise ConcentError("the weights are of another network", where=path, expected=EXPECTED, found=found) from None
    return network
