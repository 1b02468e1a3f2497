"""CUDA graphs of Warp launches and of torch operations."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
import warp as wp


class Graph:
    """Warp launches, captured once and replayed on torch's current stream."""

    def __init__(self, launches: Callable[[], None], device: Any, capture: bool) -> None:
        """Capture `launches`, which must have run before; without `capture` they are called each time."""
        self._launches, self._device, self._graph = launches, device, None
        self._streams: dict[int, wp.Stream] = {}
        if capture:
            with wp.ScopedDevice(device), wp.ScopedCapture() as captured:
                launches()
            self._graph = captured.graph

    def launch(self) -> None:
        """Launch the graph on torch's current stream."""
        stream = None
        if self._device.is_cuda:
            current = torch.cuda.current_stream(wp.device_to_torch(self._device))
            if current.cuda_stream not in self._streams:
                self._streams[current.cuda_stream] = wp.stream_from_torch(current)
            stream = self._streams[current.cuda_stream]
        with wp.ScopedDevice(self._device), wp.ScopedStream(stream):
            if self._graph is None:
                self._launches()
            else:
                wp.capture_launch(self._graph, stream=stream)


def _compiled_or_plain(part: Callable[[], None]) -> Callable[[], None]:
    """Run torch operations on fixed buffers; return them compiled into few kernels, or uncompiled if that fails."""
    from torch._dynamo.exc import TorchDynamoException

    compiled = torch.compile(part, fullgraph=True, dynamic=False)
    try:
        with torch.no_grad():
            compiled()
    except TorchDynamoException as error:
        lines = str(error).strip().splitlines()
        warnings.warn(f"operations are not fused: {lines[0] if lines else type(error).__name__}", stacklevel=2)
        return part
    return compiled


def captured(part: Callable[[], None], capture: bool, *, fuse: bool = False) -> Callable[[], None]:
    """Return torch operations on fixed buffers as a CUDA graph, fused if asked; unchanged without `capture`."""
    if not capture:
        return part
    if fuse:
        part = _compiled_or_plain(part)
    with torch.no_grad():
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(2):
                part()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            part()
    recorded = part, graph  # compiled kernels must outlive their launches
    return lambda: recorded[1].replay()
