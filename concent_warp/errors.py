"""Errors that a user can mend: one clear sentence each, printed by the command line without a traceback."""

from __future__ import annotations

import unicodedata

UNPRINTABLE = ("Cc", "Cf", "Cs", "Zl", "Zp", "Cn", "Co")
"""Unicode categories of characters that steer a terminal or are not seen: control, format, surrogate, separators, those
without a meaning."""
LONGEST_MESSAGE = 2000
"""Characters of a message; of a longer one the middle is left out."""


def printable(text: str) -> str:
    r"""Return a text on one line, with escapes in place of characters that steer a terminal.

    Example:
        >>> from concent_warp.errors import printable
        >>> printable("red" + chr(27) + "[31m")
        'red\\x1b[31m'
    """
    if text.isascii() and text.isprintable():
        return text
    line = " ".join(text.split("\n"))
    shown = (ascii(c)[1:-1] if unicodedata.category(c) in UNPRINTABLE else c for c in line)
    return "".join(shown)


def _shortened(text: str) -> str:
    """Return a message without its middle where it is very long."""
    if len(text) <= LONGEST_MESSAGE:
        return text
    half = LONGEST_MESSAGE // 2 - 10
    return f"{text[:half]} [...] {text[-half:]}"


class ConcentError(ValueError):
    """An input or a setting that cannot be worked with.

    The message is one sentence: where, what is wrong, what was expected and found, and what to do about it. Control
    characters in it, as in names that a file gives, are escaped.
    Subclasses name the kind of thing that is wrong, so that a library user can catch one kind.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_recording("nowhere.h5")
        ... except cw.ConcentError as error:
        ...     type(error).__name__
        'RecordingError'
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        expected: object = None,
        found: object = None,
        fix: str | None = None,
    ) -> None:
        sentence = what if where is None else f"{where}: {what}"
        if expected is not None:
            sentence += f"; expected {expected}"
        if found is not None:
            sentence += f", found {found}" if expected is not None else f"; found {found}"
        if fix is not None:
            sentence += f"; {fix}"
        sentence = _shortened(printable(sentence))
        super().__init__(sentence if sentence.endswith((".", "?")) else sentence + ".")


class RecordingError(ConcentError):
    """A recording file or folder that breaks the format or contradicts itself.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_recording("nowhere.h5")
        ... except cw.RecordingError as error:
        ...     str(error).startswith("nowhere.h5: no such recording")
        True
    """


class SceneError(ConcentError):
    """An MJCF, mesh or point cloud that cannot serve as a scene or an object.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_model("nowhere.xml")
        ... except cw.SceneError as error:
        ...     str(error).startswith("nowhere.xml: no such MJCF file")
        True
    """


class ModelError(ConcentError):
    """A model file, contact geometry or parameter that cannot be used.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_model("nowhere.toml")
        ... except cw.ModelError as error:
        ...     print(error)
        nowhere.toml: no such model; expected a model.toml or an MJCF .xml.
    """


class EngineError(ConcentError):
    """A simulation that an engine cannot run, or that did not stay finite or within its buffers.

    Example:
        >>> import concent_warp as cw
        >>> issubclass(cw.EngineError, cw.ConcentError)
        True
    """


class EventsError(ConcentError):
    """A contact event sequence that cannot be extracted, read or compared.

    Example:
        >>> import concent_warp as cw
        >>> issubclass(cw.EventsError, cw.ConcentError)
        True
    """


class RenderError(ConcentError):
    """Splats, images or settings with which nothing can be rendered.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.render(cw.load_policy("shape_sorter"), "dataset", cw.RenderCfg(episodes=0))
        ... except cw.RenderError as error:
        ...     print(error)
        episodes is out of bounds; expected at least 1 and at most 1e+07, found 0.
    """


class TrainError(ConcentError):
    """A training that cannot be set up, gone on with or evaluated.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_policy("dishwasher")
        ... except cw.TrainError as error:
        ...     str(error).startswith("no such policy")
        True
    """
