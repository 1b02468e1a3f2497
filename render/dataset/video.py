"""Videos by PyAV: frames go in one by one, and whole videos are joined without being encoded again."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np

from concent_warp.files import DiskFile

Codec = Literal["h264", "av1"]
"""How colours are encoded."""
ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    # A key frame every second frame lets readers that pick frames at random decode little, as LeRobot has it.
    "h264": ("libx264", {"g": "2", "crf": "20", "preset": "veryfast", "bf": "0"}),
    "av1": ("libsvtav1", {"g": "2", "crf": "30", "preset": "8", "svtav1-params": "pred-struct=1"}),
    # Depths are codes, of which no bit may change.
    "depth": ("libx265", {"preset": "veryfast", "x265-params": "lossless=1:keyint=2:bframes=0:log-level=none"}),
}
"""Encoder and its options, by codec. Pictures come in their order, so that videos can be joined."""
PIXELS, DEPTH_PIXELS = "yuv420p", "gray12le"


class VideoWriter:
    """One video that grows frame by frame."""

    def __init__(self, path: Path, rate: int, size: tuple[int, int], codec: Codec | Literal["depth"] = "h264") -> None:
        """Open it.

        Args:
            path: File to write.
            rate: Frames a second.
            size: Height and width [px], even.
            codec: How frames are encoded; "depth" for codes of 12 bits.
        """
        import av

        name, options = ENCODERS[codec]
        self._disk = DiskFile(path)
        self._container = av.open(self._disk, "w", format="mp4")
        stream: Any = self._container.add_stream(name, rate=rate, options=options)
        stream.height, stream.width = size
        self._format = DEPTH_PIXELS if codec == "depth" else "rgb24"
        stream.pix_fmt = DEPTH_PIXELS if codec == "depth" else PIXELS
        stream.codec_context.thread_count = 1
        self._stream = stream

    def add(self, image: np.ndarray) -> None:
        """Add a frame, shape (H, W, 3) uint8, or codes of depths, shape (H, W) uint16.

        Raises:
            OSError: The file cannot be written, as on a full disk.
        """
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=self._format)
        self._container.mux(self._stream.encode(frame))
        self._disk.check()

    def abandon(self) -> None:
        """Close a discarded file; it may have no frames."""
        from av.error import FFmpegError

        try:
            self._container.close()
        except FFmpegError:  # without frames there is no stream to end
            return
        finally:
            self._disk.close()

    def close(self) -> None:
        """Write what is left and close the file.

        Raises:
            OSError: The file cannot be written, as on a full disk.
        """
        self._container.mux(self._stream.encode(None))
        self._container.close()
        self._disk.close()
        self._disk.check()


def join_videos(paths: Sequence[Path], lengths: Sequence[int], rate: int, out: Path) -> None:
    """Put videos of the same encoding one after the other into one file, packet by packet.

    Args:
        paths: The videos.
        lengths: Frames of each.
        rate: Frames a second.
        out: File to write.

    Raises:
        OSError: The file cannot be written, as on a full disk.
    """
    import av

    with DiskFile(out) as disk, av.open(disk, "w", format="mp4") as whole:
        stream: Any = None
        before = 0
        for path, length in zip(paths, lengths, strict=True):
            with av.open(str(path)) as part:
                source = part.streams.video[0]
                if stream is None:
                    stream = whole.add_stream_from_template(source)
                    stream.time_base = source.time_base
                assert source.time_base is not None
                offset = round(Fraction(before, rate) / source.time_base)
                for packet in part.demux(source):
                    if packet.dts is None or packet.pts is None:
                        continue
                    packet.pts, packet.dts = packet.pts + offset, packet.dts + offset
                    packet.stream = stream
                    whole.mux(packet)
            before += length
    disk.check()
