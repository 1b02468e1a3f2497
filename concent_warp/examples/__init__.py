"""Recordings that come with the package, for examples and first steps."""

from __future__ import annotations

from pathlib import Path

from concent_warp.errors import ConcentError


def example(name: str) -> Path:
    """Return the path of a recording that comes with the package.

    Args:
        name: "servo", four seconds of a servo that swings a payload; its nominal model lacks friction in the joint.

    Raises:
        ConcentError: There is no recording of this name.

    Example:
        >>> import concent_warp as cw
        >>> cw.load_recording(cw.example("servo")).demonstrations[0].name
        'demo_0'
    """
    path = Path(__file__).parent / f"{name}.h5"
    if not path.is_file():
        names = sorted(one.stem for one in path.parent.glob("*.h5"))
        raise ConcentError("no such example recording", expected=f"one of {names}", found=name)
    return path
