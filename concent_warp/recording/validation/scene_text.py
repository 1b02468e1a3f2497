"""Checks of a recording's MJCF text before it is compiled: self-contained and of limited size."""

from __future__ import annotations

import math
from xml.etree import ElementTree

from concent_warp.limits import limits, raising
from concent_warp.recording.validation.location import ErrorLocation

FREE_TEXT = ("name", "class", "data")
"""Attributes that hold words, so that ``nan`` is not a number in them."""
LONGEST_SHOWN = 80
"""Characters of a text that is no scene which a message shows."""


def check_scene_text(text: str, place: ErrorLocation) -> None:
    """Refuse an MJCF text that is no XML, reads other files, asks for endless copies or holds numbers that are none.

    Raises:
        RecordingError: With the element that is at fault.
    """
    if len(text) > limits().scene_bytes:
        raise place.error(
            "the scene's MJCF is too long",
            expected=f"at most {limits().scene_bytes} bytes",
            fix=raising("scene_bytes"),
            found=len(text),
        )
    if not text.strip():
        raise place.error("the scene is empty", expected="MJCF text", fix="write the MJCF into the recording")
    check_is_mjcf(text, place)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise place.error("the scene declares XML entities, which MJCF does not need", fix="remove the DOCTYPE")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise place.error("the scene is not XML", expected="MJCF text", found=error) from None
    stack = [(root, 1)]
    while stack:
        element, copies = stack.pop()
        copies = _check_element(element, copies, place)
        stack.extend((child, copies) for child in element)


def check_is_mjcf(text: str, place: ErrorLocation) -> None:
    """Refuse a text without any element, such as the path of an MJCF file."""
    if "<" not in text:
        raise place.error(
            "the scene is not XML",
            expected="MJCF text",
            found=repr(text[:LONGEST_SHOWN]),
            fix="read a file with Scene.from_mjcf(path).xml",
        )


def _check_element(element: ElementTree.Element, copies: int, place: ErrorLocation) -> int:
    """Check one element; `copies` counts how often those around it repeat it, the result how often it does in turn."""
    if element.tag == "include" or "file" in element.attrib:
        raise place.error(
            f"the scene is not self-contained: its <{element.tag}> reads a file",
            found=element.get("file"),
            fix="write meshes as inline vertices and drop textures, or name the MJCF in the attribute 'path'",
        )
    if element.tag in ("replicate", "composite", "flexcomp"):
        try:
            copies *= math.prod(max(int(n), 1) for n in element.get("count", "1").split())
        except ValueError:
            raise place.error(f"<{element.tag}> has no whole count", found=element.get("count")) from None
        if copies > limits().scene_copies:
            raise place.error(
                f"<{element.tag}> asks for too many copies",
                expected=f"at most {limits().scene_copies}",
                fix=raising("scene_copies"),
                found=copies,
            )
    for key, value in element.attrib.items():
        if key not in FREE_TEXT and _not_finite(value):
            raise place.error(f"<{element.tag} {key}> is not finite", expected="finite numbers", found=value)
    return copies


def _not_finite(text: str) -> bool:
    """Return whether a text is a list of numbers one of which is not finite."""
    try:
        return not all(math.isfinite(float(part)) for part in text.split())
    except ValueError:
        return False
