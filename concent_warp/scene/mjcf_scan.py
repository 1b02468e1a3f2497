"""Scan of an MJCF before MuJoCo reads it: nesting, inclusion of itself, files that it reads, sizes that it asks for.

MuJoCo reads a scene without limits: one that attaches itself ends the process, and one that asks for a texture of
60,000 x 60,000 pixels takes all memory. What is certain to be of that kind is refused here; what may be is marked by
`Scan.unusual`, and `trial_compile` tries it in a process of its own.
"""

from __future__ import annotations

import math
import re
import struct
import xml.parsers.expat
from dataclasses import dataclass
from pathlib import Path

from concent_warp.errors import SceneError, printable
from concent_warp.limits import limits, raising

COUNTS = re.compile(
    r"count|dim|nsample|nuser\w*|nuserdata|nkey|njmax|nconmax|nstack|nrow|ncol|width|height|\w*iterations|\w*resolution|"
    r"offwidth|offheight|shadowsize|numquads|numslices|numstacks|maxhullvert|sdf_initpoints|nthread|maxdepth"
)
"""Attributes that ask for a number of something."""
REPEATING = ("replicate", "composite", "flexcomp")
"""Elements that repeat what is in them, or make many bodies of one element."""
FILE_FOLDERS = {"meshdir", "texturedir", "assetdir"}
"""Attributes of <compiler> that name folders of files."""
PICTURES = ("texture", "hfield")
"""Elements whose files are pictures, or grids with a header of two sizes."""
OFFSCREEN = ("offwidth", "offheight")
"""Attributes of <global> that are the size of an image."""
UNIT_BYTES = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40, "P": 1 << 50, "E": 1 << 60}
PNG = b"\x89PNG\r\n\x1a\n"
UNUSUAL_COUNT = 10_000
"""Size from which on a scene is tried in a process of its own."""
UNUSUAL_ELEMENTS = 20_000
"""Elements, repetitions counted in, from which on a scene is tried."""
UNUSUAL_BYTES = 20_000_000
"""Bytes of the files of a scene, or of its text, from which on it is tried."""
UNUSUAL_CELLS = 1 << 22
"""Pixels of a texture or cells of a height field from which on a scene is tried."""


@dataclass(frozen=True)
class Scan:
    """What a scan has found."""

    unusual: bool
    """Whether the scene is so large or odd that compiling it is to be tried first."""
    outside: tuple[str, ...]
    """Files that the scene reads from outside its folder, as they are written in it."""


def scan_text(text: str, source: str) -> Scan:
    """Scan an MJCF text that stands alone.

    Raises:
        SceneError: It is nested too deeply, asks for too much or declares XML entities.
    """
    return _Scanner(None, source).run(text.encode("utf-8", "surrogatepass"))


def scan_file(path: Path) -> Scan:
    """Scan an MJCF file with all that it includes and attaches.

    Raises:
        SceneError: As for `scan_text`; or a file is too large or no regular file, or includes or attaches itself.
    """
    return _Scanner(path, str(path)).run(_read(path, str(path)))


class _Scanner:
    """The state of one scan."""

    def __init__(self, path: Path | None, source: str) -> None:
        self.source, self.limits = source, limits()
        self.unusual, self.outside = False, list[str]()
        self.main = path
        self.folder = None if path is None else path.parent
        self.open = [] if path is None else [path.resolve()]
        self.elements, self.bytes = 0, 0
        self.depth, self.copies = 0, [1]
        self.folders, self.files = {""}, list[tuple[str, str]]()

    def run(self, text: bytes) -> Scan:
        """Scan the main text, then the files that it names."""
        self.parse(text)
        if self.folder is not None:
            for tag, name in self.files:
                self.check_asset(tag, name, self.folder)
        self.unusual |= self.elements > UNUSUAL_ELEMENTS or self.bytes > UNUSUAL_BYTES
        return Scan(self.unusual, tuple(self.outside))

    def error(
        self,
        what: str,
        limit: str | None = None,
        *,
        expected: object = None,
        found: object = None,
        fix: str | None = None,
    ) -> SceneError:
        """Return the error about the scene; `limit` names the limit that it exceeds."""
        fix = raising(limit) if limit is not None else fix
        return SceneError(what, where=self.source, expected=expected, found=found, fix=fix)

    def parse(self, text: bytes) -> None:
        """Scan one text; depth and repetitions go on from where it is included."""
        self.bytes += len(text)
        if self.bytes > self.limits.scene_bytes:
            raise self.error("the MJCF is too long", "scene_bytes", expected=_most(self.limits.scene_bytes, "bytes"))
        _refuse_control_characters(text, self.source)
        parser = xml.parsers.expat.ParserCreate()
        parser.StartElementHandler = self.start
        parser.EndElementHandler = self.end
        parser.StartDoctypeDeclHandler = self.doctype
        depth, copies = self.depth, list(self.copies)
        try:
            parser.Parse(text, True)
        except xml.parsers.expat.ExpatError:
            # MuJoCo's own parser is laxer, for instance about comments; it says what is wrong, in another process.
            self.unusual = True
            self.depth, self.copies = depth, copies

    def doctype(self, *_: object) -> None:
        """Refuse a document type, which can declare entities that grow without end."""
        raise self.error("the MJCF declares XML entities, which it does not need", fix="remove the DOCTYPE")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Check the start of an element."""
        self.depth += 1
        if self.depth > self.limits.scene_depth:
            raise self.error(
                f"<{tag}> lies too deep in other elements",
                "scene_depth",
                expected=_most(self.limits.scene_depth, "levels"),
            )
        copies = self.copies[-1] * self.repetitions(tag, attributes)
        if copies > self.limits.scene_copies:
            raise self.error(
                f"<{tag}> asks for too many copies",
                "scene_copies",
                expected=f"at most {self.limits.scene_copies}",
                found=copies,
            )
        self.copies.append(copies)
        self.elements += copies
        self.check_sizes(tag, attributes)
        if tag == "compiler":
            self.folders |= {attributes[name] for name in FILE_FOLDERS & set(attributes)}
        named = [(name, value) for name, value in attributes.items() if name.startswith("file") and value]
        for _, value in named:
            if tag in ("include", "model"):
                self.enter(tag, value)
            else:
                self.files.append((tag, value))

    def end(self, _: str) -> None:
        """Leave an element."""
        self.depth -= 1
        self.copies.pop()

    def repetitions(self, tag: str, attributes: dict[str, str]) -> int:
        """Return how often an element repeats what is in it."""
        if tag not in REPEATING:
            return 1
        try:
            counts = [int(n) for n in attributes.get("count", "1").split()]
        except ValueError:
            raise self.error(f"<{tag}> has no whole count", found=attributes["count"][:40]) from None
        if min(counts, default=1) < 0:
            raise self.error(f"<{tag}> has a negative count", expected="at least 0", found=attributes["count"][:40])
        return math.prod(max(n, 1) for n in counts)

    def check_sizes(self, tag: str, attributes: dict[str, str]) -> None:
        """Refuse sizes above the limits, and mark large ones as unusual."""
        for name, value in attributes.items():
            if name.endswith("range"):
                self.check_range(tag, name, value)
            if not COUNTS.fullmatch(name):
                continue
            largest = max((abs(n) for n in _numbers(value)), default=0.0)
            if largest > self.limits.scene_count and tag not in REPEATING:
                raise self.error(
                    f"<{tag} {name}> is too large",
                    "scene_count",
                    expected=f"at most {self.limits.scene_count}",
                    found=value[:40],
                )
            self.unusual |= largest > UNUSUAL_COUNT
        if tag in PICTURES:
            sides = [attributes.get(n, "1") for n in (("width", "height") if tag == "texture" else ("nrow", "ncol"))]
            self.check_cells(tag, math.prod(max(_numbers(side), default=1.0) for side in sides))
        if tag == "global":
            self.check_cells(tag, math.prod(max(_numbers(attributes.get(n, "1")), default=1.0) for n in OFFSCREEN))
        if tag == "size" and (memory := attributes.get("memory", "").strip()):
            unit = UNIT_BYTES.get(memory[-1].upper(), 1)
            asked = max(_numbers(memory.rstrip("KMGTPEkmgtpe")), default=0.0) * unit
            if asked > self.limits.scene_arena_bytes:
                raise self.error(
                    "<size memory> is too large",
                    "scene_arena_bytes",
                    expected=_most(self.limits.scene_arena_bytes, "bytes"),
                    found=memory[:40],
                )

    def check_range(self, tag: str, name: str, value: str) -> None:
        """Refuse a range whose ends are reversed, which MuJoCo takes for none."""
        ends = _numbers(value)
        if len(ends) == 2 and ends[0] > ends[1]:
            raise self.error(f"<{tag} {name}> is reversed", expected="its lower end first", found=value[:40])

    def check_cells(self, tag: str, cells: float) -> None:
        """Refuse a picture or a grid that is too large."""
        if not cells <= self.limits.scene_cells:
            raise self.error(
                f"a <{tag}> is too large",
                "scene_cells",
                expected=_most(self.limits.scene_cells, "cells"),
                found=f"{cells:,.0f}",
            )
        self.unusual |= cells > UNUSUAL_CELLS

    def enter(self, tag: str, name: str) -> None:
        """Scan a file that is included or attached."""
        if self.folder is None:
            return
        self.note_outside(name, self.folder / name)
        for path in dict.fromkeys((self.folder / name, self.open[-1].parent / name)):
            if not path.exists():
                continue
            if path.resolve() in self.open:
                raise self.error(f"its <{tag}> reads the file that it is in", found=name[:80], fix="remove it")
            text = _read(path, self.source)
            self.open.append(path.resolve())
            if len(self.open) > self.limits.scene_depth:
                raise self.error("files include one another too deeply", "scene_depth", found=len(self.open))
            folder, main = self.folder, tag == "model"
            self.folder = path.parent if main else folder  # an attached model names files from its own folder
            self.parse(text)
            self.folder = folder
            self.open.pop()

    def check_asset(self, tag: str, name: str, folder: Path) -> None:
        """Check a file that MuJoCo reads as a mesh, a texture or the like; one that is missing is MuJoCo's to say."""
        bare = Path(name).name
        for path in {folder / place / kind for place in self.folders for kind in (name, bare)}:
            if not path.exists():
                continue
            self.note_outside(name, path)
            if not path.is_file():
                raise self.error(f"its <{tag}> reads something that is no file", found=name[:80])
            size = path.stat().st_size
            if size > self.limits.file_bytes:
                raise self.error(
                    f"the file of its <{tag}> is too large",
                    "file_bytes",
                    expected=_most(self.limits.file_bytes, "bytes"),
                    found=size,
                )
            self.bytes += size
            if tag in PICTURES:
                self.check_cells(tag, _picture_cells(path))

    def note_outside(self, name: str, path: Path) -> None:
        """Note a file that does not lie in the folder of the scene, or below it."""
        assert self.main is not None
        if not path.resolve().is_relative_to(self.main.parent.resolve()) and name not in self.outside:
            self.outside.append(name)


def _read(path: Path, source: str) -> bytes:
    """Return the bytes of an MJCF file."""
    if not path.is_file():
        raise SceneError("what it includes is no file", where=source, found=str(path))
    if path.stat().st_size > limits().scene_bytes:
        raise SceneError(
            f"{path.name} is too long for an MJCF",
            where=source,
            expected=_most(limits().scene_bytes, "bytes"),
            found=path.stat().st_size,
            fix=raising("scene_bytes"),
        )
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError("the file cannot be read", where=path, found=error.strerror) from None


def _picture_cells(path: Path) -> int:
    """Return how many pixels the header of a PNG states, or cells that of a height field; 0 where there is none."""
    with path.open("rb") as file:
        head = file.read(24)
    if head.startswith(PNG) and len(head) == 24:
        width, height = struct.unpack(">II", head[16:24])
        return width * height
    if path.suffix.lower() != ".png" and len(head) >= 8:
        rows, columns = struct.unpack("<ii", head[:8])
        return 4 * rows * columns if 4 * rows * columns <= path.stat().st_size else 0
    return 0


def _refuse_control_characters(text: bytes, source: str) -> None:
    """Refuse characters that steer a terminal, as they are and as references, which XML does not allow either."""
    found = re.search(
        rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]|&#(?:x0*(?:1?[0-9a-fA-F]|7[fF])|0*(?:[12]?\d|3[01]|127));", text
    )
    if found and found.group() not in (b"&#9;", b"&#10;", b"&#13;", b"&#x9;", b"&#xA;", b"&#xD;", b"&#xa;", b"&#xd;"):
        if text.startswith((b"\xff\xfe", b"\xfe\xff")):
            raise SceneError("the MJCF is not UTF-8 text", where=source, found="UTF-16", fix="save it as UTF-8")
        raise SceneError(
            "the MJCF holds a control character", where=source, found=printable(repr(found.group())), fix="remove it"
        )


def _numbers(text: str) -> list[float]:
    """Return the numbers in a text, as far as it holds any."""
    found = []
    for part in text.split():
        try:
            found.append(float(part))
        except ValueError:
            continue
    return found


def _most(limit: float, unit: str) -> str:
    """Return a limit in words."""
    return f"at most {limit:,.0f} {unit}"
