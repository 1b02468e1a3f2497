"""Fit of Gaussian splats to posed images by descent, with splitting and pruning ("3D Gaussian Splatting", 2023).

Colours are compared premultiplied, and opacity with the masks, so that what is fitted is the object without background:

    loss = (1 - s) mean |rgb - rgb*| + s (1 - SSIM) / 2 + m mean |alpha - mask|

by Adam, each parameter at a rate of its own. Now and then the Gaussians whose places in the images pull hardest are
split in two along their longest axis, and faint ones are taken out. Nothing is random after the start: a fit
that goes on from a checkpoint ends where it would have ended.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from concent_warp.array_file import write_arrays
from concent_warp.errors import RenderError
from concent_warp.render.splats.cfg import SplatFitCfg
from concent_warp.render.splats.initial import first_splats
from concent_warp.render.splats.rasterise import Rasteriser
from concent_warp.render.splats.splats import Splats
from concent_warp.render.splats.views import SplatViews

Report = Callable[[int, float], None]
"""Called with the number of steps done and the loss."""
NAMES = ("means", "quats", "scales", "opacities", "constant", "rest")
MOMENTS = ("exp_avg", "exp_avg_sq")
IDENTITY_POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Position [m] and quaternion wxyz."""


@dataclass(frozen=True)
class Score:
    """Errors of the splats on one image."""

    view: int
    psnr: float
    """Peak signal-to-noise ratio over the whole image, before black [dB]."""
    psnr_object: float
    """The same over the pixels that the mask or the splats cover alone [dB]."""


class SplatFit:
    """A fit in progress.

    Args:
        views: posed images.
        points: where to start [m], frame of the object, shape (n, 3).
        cfg: settings.
        device: where to compute, "cpu" or "cuda:0".
    """

    iteration: int = 0
    """Steps done."""

    def __init__(
        self, views: SplatViews, points: np.ndarray, cfg: SplatFitCfg, *, device: str | torch.device = "cpu"
    ) -> None:
        self.views, self.cfg, self.device = views, cfg, torch.zeros(0, device=device).device
        every = cfg.held_out if cfg.held_out > 0 else len(views) + 1
        self.held_out = [v for v in range(len(views)) if v % every == every - 1]
        self.fitted = [v for v in range(len(views)) if v not in self.held_out]
        if not self.fitted:
            raise RenderError("no images are left to fit", expected="more images than are held out", found=len(views))
        rgba = torch.from_numpy(views.rgba).to(self.device).float() / 255
        self._mask = rgba[..., 3].contiguous()
        self._rgb = (rgba[..., :3] * rgba[..., 3:]).contiguous()
        self._known = None if views.known is None else torch.from_numpy(views.known).to(self.device).float()
        if self._known is not None:
            self._mask, self._rgb = self._mask * self._known, self._rgb * self._known[..., None]
        self._poses = torch.tensor(views.camera_poses(), dtype=torch.float32, device=self.device)
        self._intrinsics = torch.tensor(views.intrinsics, dtype=torch.float32, device=self.device)
        self._still = torch.tensor([[IDENTITY_POSE]], device=self.device)
        first = first_splats(views, points, cfg, self.device)
        self._extent = float((first.means - first.means.mean(dim=0)).norm(dim=1).quantile(0.95))
        means, quats, scales, opacities, harmonics = first.tensors()
        values = [means, quats, scales.log(), opacities.logit(), harmonics[:, :1], harmonics[:, 1:]]
        self._room = 4 * len(first)
        self._begin(dict(zip(NAMES, values, strict=True)), {})

    def _begin(self, values: dict[str, torch.Tensor], moments: dict[str, torch.Tensor]) -> None:
        """Set parameters and their Adam moments."""
        rates = self.cfg.rates
        rate = {"quats": rates.quats, "scales": rates.scales, "opacities": rates.opacities, "constant": rates.colour}
        rate |= {"means": 0.0, "rest": rates.colour / 10}  # that of the means falls, see `step`
        self.parameters = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        groups = [{"params": [self.parameters[name]], "lr": rate[name], "name": name} for name in NAMES]
        self._adam = torch.optim.Adam(groups, eps=1e-15)
        for name in NAMES if moments else ():
            self._adam.state[self.parameters[name]] = {
                "step": torch.tensor(float(self.iteration)),
                **{kind: moments[f"{name}.{kind}"].clone() for kind in MOMENTS},
            }
        self._pull = torch.zeros(len(self), device=self.device)
        self._make_rasteriser()

    def _make_rasteriser(self) -> None:
        with torch.no_grad():
            self._rasteriser = Rasteriser(
                [self.splats()], *self.views.size, 1, self.cfg.views, capacity=self._room, device=self.device,
                gradient=True,
            )  # fmt: skip

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def splats(self) -> Splats:
        """Return the present splats, differentiable."""
        p = self.parameters
        harmonics = torch.cat([p["constant"], p["rest"]], dim=1)
        return Splats(p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), harmonics)

    def learn(self, report: Report | None = None, checkpoint: Path | None = None) -> Splats:
        """Run the remaining steps with periodic checkpoints, and return the splats."""
        saved = time.monotonic()
        while self.iteration < self.cfg.iterations:
            loss = self.step()
            if report is not None and (self.iteration % 10 == 0 or self.iteration == self.cfg.iterations):
                report(self.iteration, float(loss))
            due = time.monotonic() - saved > self.cfg.checkpoint_period or self.iteration == self.cfg.iterations
            if checkpoint is not None and due:
                self.save(checkpoint)
                saved = time.monotonic()
        return Splats(*(t.detach() for t in self.splats().tensors()))

    def step(self) -> torch.Tensor:
        """Take one step and return the loss before it, not yet waited for."""
        from kornia.losses import ssim_loss

        which = self._which()
        layer = self._rasteriser.differentiable(
            [self.splats()], self._still, self._poses[which][None], self._intrinsics[which][None]
        )
        rgb, alpha = layer.rgb[0], layer.alpha[0]
        if self._known is not None:
            rgb, alpha = rgb * self._known[which][..., None], alpha * self._known[which]
        loss = (1 - self.cfg.ssim) * (rgb - self._rgb[which]).abs().mean()
        if self.cfg.ssim > 0:
            images = (t.permute(0, 3, 1, 2) for t in (rgb, self._rgb[which]))
            loss = loss + self.cfg.ssim * ssim_loss(*images, window_size=11)
        if self.views.masked:
            loss = loss + self.cfg.mask * (alpha - self._mask[which]).abs().mean()
        self._adam.zero_grad()
        loss.backward()
        self._adam.param_groups[0]["lr"] = (
            self.cfg.rates.means * self._extent * 0.01 ** (self.iteration / self.cfg.iterations)
        )
        self._adam.step()
        self.iteration += 1
        pixels = wp.to_torch(self._rasteriser.plan.gradients["pixels"])[:, :2]
        self._pull += pixels.norm(dim=1).view(self.cfg.views, -1).sum(dim=0)
        if self.iteration % 10 == 0:
            self._check_room()
        if self.iteration % self.cfg.every == 0 and 3 * self.iteration <= 2 * self.cfg.iterations:
            self.reshape()
        loss = loss.detach()
        if self.iteration % 100 == 0 and not math.isfinite(float(loss)):
            raise RenderError("the fit diverged", found=f"a loss of {float(loss)}", fix="lower the rates")
        return loss

    def _which(self) -> torch.Tensor:
        """Return the images of this step: all in turn, in a new random order for each pass."""
        taken = np.arange(self.cfg.views) + self.iteration * self.cfg.views
        count = len(self.fitted)
        orders = {r: np.random.default_rng([self.cfg.seed, r]).permutation(count) for r in np.unique(taken // count)}
        return torch.tensor([self.fitted[orders[k // count][k % count]] for k in taken], device=self.device)

    def _check_room(self) -> None:
        needed = int(self._rasteriser.pairs.max())
        if 1.3 * needed > self._room:
            self._room = 2 * needed
            self._make_rasteriser()

    @torch.no_grad()
    def reshape(self) -> None:
        """Split the Gaussians with the largest gradients, and remove transparent and oversized ones."""
        p = self.parameters
        longest, axis = p["scales"].max(dim=1)
        kept = (p["opacities"].sigmoid() > self.cfg.faint) & (longest.exp() < 0.5 * self._extent)
        if int(kept.sum()) < 10:
            raise RenderError("the splats faded away", fix="check the poses of the images, or lower the rates")
        room = max(min(int(self.cfg.grow * len(self)), self.cfg.most - int(kept.sum())), 0)
        pull = torch.where(kept, self._pull, -1.0)
        split = torch.zeros_like(kept)
        split[pull.topk(min(room, len(pull))).indices] = True
        split &= kept
        index = torch.cat([torch.nonzero(kept & ~split)[:, 0], *(torch.nonzero(split)[:, 0],) * 2])
        halves = int(split.sum())
        values = {name: p[name][index].clone() for name in NAMES}
        side = torch.zeros(len(index), device=self.device)
        side[len(index) - 2 * halves :] = 1
        side[len(index) - halves :] = -1
        offset = torch.zeros(len(index), 3, device=self.device)
        offset.scatter_(1, axis[index, None], (0.6 * side * longest[index].exp())[:, None])
        values["means"] += _turned(values["quats"], offset)
        values["scales"] -= torch.log(torch.tensor(1.5)) * (offset != 0)
        whole = values["opacities"].sigmoid()
        # Two of these cover as much as the one did.
        values["opacities"] = torch.where(side != 0, 1 - (1 - whole).sqrt(), whole).logit()
        moments = {}
        for name in NAMES:
            state = self._adam.state[p[name]]
            for kind in MOMENTS:
                moments[f"{name}.{kind}"] = state[kind][index]
        self._begin(values, moments)

    @torch.no_grad()
    def evaluate(self, which: list[int] | None = None) -> list[Score]:
        """Compare the splats with images, by default those that were held out."""
        splats = Splats(*(t.detach() for t in self.splats().tensors()))
        rasteriser = Rasteriser([splats], *self.views.size, device=self.device)
        scores = []
        for v in self.held_out if which is None else which:
            layer = rasteriser.render(self._still, self._poses[v], self._intrinsics[v])
            error = (layer.rgb[0, 0].clamp(0, 1) - self._rgb[v]).square().mean(dim=-1)
            covered = (layer.alpha[0, 0] > 0.01) | (self._mask[v] > 0)
            if self._known is not None:
                tells = self._known[v] > 0
                error, covered = error[tells], covered[tells]
            ratios = [float(-10 * torch.log10(part.mean().clamp(min=1e-10))) for part in (error, error[covered])]
            scores.append(Score(v, *ratios))
        return scores

    @torch.no_grad()
    def picture(self, v: int) -> np.ndarray:
        """Return an image and below it the splats, before white, uint8, shape (2 H, W, 3)."""
        layer = Rasteriser([self.splats()], *self.views.size, device=self.device).render(
            self._still, self._poses[v], self._intrinsics[v]
        )
        seen = torch.cat(
            [self._rgb[v] + 1 - self._mask[v][..., None], layer.rgb[0, 0] + 1 - layer.alpha[0, 0, ..., None]]
        )
        return (255 * seen.clamp(0, 1)).round().byte().cpu().numpy()

    def signature(self) -> int:
        """Return a checksum of the images."""
        parts = [self.views.rgba, self.views.poses, self.views.intrinsics]
        if self.views.known is not None:
            parts.append(self.views.known)
        return zlib.crc32(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))

    def save(self, path: Path) -> None:
        """Write a checkpoint atomically."""
        content: dict[str, Any] = {"iteration": self.iteration, "room": self._room, "signature": self.signature()}
        content |= {name: value.detach().cpu().numpy() for name, value in self.parameters.items()}
        for name, value in self.parameters.items():
            state = self._adam.state[value]
            content |= {f"{name}.{kind}": state[kind].cpu().numpy() for kind in MOMENTS}
        content["pull"] = self._pull.cpu().numpy()
        write_arrays(path, content)

    def resume(self, path: Path) -> None:
        """Return the fit of a checkpoint that `save` wrote.

        Raises:
            RenderError: the file is broken, or belongs to a fit of other images.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                stored: dict[str, Any] = {name: data[name] for name in data.files}
            tensors = {
                name: torch.from_numpy(stored[name]).to(self.device)
                for name in (*NAMES, *(f"{n}.{kind}" for n in NAMES for kind in MOMENTS), "pull")
            }
            numbers = {name: int(stored[name]) for name in ("iteration", "room", "signature")}
        except Exception as error:  # NumPy, zipfile and json raise whatever their parsers do
            raise RenderError(
                "not a checkpoint of a fit of splats", where=path, found=error, fix="delete it to start anew"
            ) from None
        if numbers["signature"] != self.signature():
            raise RenderError("the checkpoint belongs to a fit of other images", where=path, fix="start anew")
        self.iteration, self._room = numbers["iteration"], numbers["room"]
        self._begin({name: tensors[name] for name in NAMES}, tensors)
        self._pull = tensors["pull"].clone()


def _turned(quats: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Return vectors (n, 3) turned by quaternions wxyz (n, 4) of any length."""
    unit = quats / quats.norm(dim=1, keepdim=True)
    scalar, axis = unit[:, :1], unit[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + scalar * across + torch.linalg.cross(axis, across)
