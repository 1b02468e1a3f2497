"""Flow matching (Lipman et al. 2023) on straight lines from noise to image: loss and sampling.

Between noise x_0 and image x_1 lies x_t = (1 - t) x_0 + t x_1, whose velocity is x_1 - x_0 = (x_1 - x_t) / (1 - t). The
network predicts x_1 (paper, appendix E: "the output is the denoised image").
"""

from __future__ import annotations

import torch

from concent_warp.render.networks.flow_network import FlowNetwork


def flow_loss(
    network: torch.nn.Module,
    image: torch.Tensor,
    simulated: torch.Tensor,
    previous: torch.Tensor,
    pose: torch.Tensor | None,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Return the loss of a batch of images in -1..1, shape (N, 3, S, S): mean squared and absolute error, halved.

    Args:
        network: A `FlowNetwork`.
        image: Real images, shape (N, 3, S, S).
        simulated: The simulation's, same shape.
        previous: The real ones before them, same shape.
        pose: Poses of the end-effector, shape (N, 9), where these are a condition.
        generator: Source of times and noise, on the images' device.
    """
    count, device = len(image), image.device
    time = torch.rand(count, generator=generator, device=device)
    noise = torch.randn(image.shape, generator=generator, device=device)
    share = time[:, None, None, None]
    found = network((1 - share) * noise + share * image, time, simulated, previous, pose).float()
    return 0.5 * (torch.nn.functional.mse_loss(found, image) + torch.nn.functional.l1_loss(found, image))


@torch.no_grad()
def sample_images(
    network: FlowNetwork | torch.nn.Module,
    simulated: torch.Tensor,
    previous: torch.Tensor,
    pose: torch.Tensor | None,
    *,
    steps: int,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Return images in -1..1, shape (N, 3, S, S), by Euler steps along the flow.

    Args:
        network: A `FlowNetwork`.
        simulated: The simulation's images, shape (N, 3, S, S).
        previous: The previously sampled images, same shape.
        pose: Poses of the end-effector, shape (N, 9), where these are a condition.
        steps: Steps from noise to image.
        generator: Source of the noise, on the images' device.
    """
    x = torch.randn(simulated.shape, generator=generator, device=simulated.device)
    for k in range(steps):
        time = torch.full((len(x),), k / steps, device=x.device)
        image = network(x, time, simulated, previous, pose)
        x = x + (image - x) / (steps - k)
    return x.clamp(-1, 1)
