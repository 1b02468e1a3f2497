"""Each reader of TOML and JSON, given texts that are hostile to parsers, refuses them in one printable line."""

import os
from pathlib import Path

import pytest

from concent_warp.documents import read_json, read_toml
from concent_warp.errors import ConcentError
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model
from concent_warp.recording.formats.bam import read_bam
from concent_warp.render.splats.views import read_views
from concent_warp.train.cfg import TrainCfg

READERS = {
    "TOML": (read_toml, ".toml"),
    "JSON": (read_json, ".json"),
    "model": (Model.load, ".toml"),
    "training": (TrainCfg.load, ".toml"),
    "servo log": (read_bam, ".json"),
    "contact events": (ContactEventSequence.load, ".json"),
    "posed images": (read_views, ".json"),
}
CONTENTS = {
    "brackets": b"[" * 100_000,
    "braces": b'{"a":' * 100_000,
    "arrays in TOML": b"a = " + b"[" * 100_000,
    "tables in TOML": b"a = " + b"{b = " * 100_000,
    "long number": b'{"version": ' + b"9" * 5000 + b"}",
    "long number in TOML": b"version = " + b"9" * 5000,
    "NUL": b"a = 1\x00",
    "escape sequence": b'"\x1b[31m',
    "UTF-16": "a = 1".encode("utf-16"),
    "binary": bytes(range(256)),
    "cut": b'{"format": "con',
    "lone surrogate": b'a = "\xed\xa0\x80"',
}


def refusal(read, path: Path) -> str:
    with pytest.raises(ConcentError) as caught:
        read(path)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 2500
    return message


@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS.keys())
@pytest.mark.parametrize(("read", "suffix"), READERS.values(), ids=READERS.keys())
def test_hostile_texts_are_refused(tmp_path, read, suffix, content):
    path = tmp_path / f"file{suffix}"
    path.write_bytes(content)
    assert str(path) in refusal(read, path)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "nothing"])
@pytest.mark.parametrize(("read", "suffix"), READERS.values(), ids=READERS.keys())
def test_what_is_no_file_is_refused_at_once(tmp_path, read, suffix, kind):
    path = tmp_path / f"file{suffix}"
    {
        "pipe": lambda: os.mkfifo(path),
        "device": lambda: path.symlink_to("/dev/zero"),
        "folder": path.mkdir,
        "nothing": lambda: None,
    }[kind]()
    assert str(path) in refusal(read, path)


@pytest.mark.parametrize(("read", "suffix"), READERS.values(), ids=READERS.keys())
def test_a_file_above_the_limit_is_refused_with_how_to_raise_it(tmp_path, monkeypatch, read, suffix):
    monkeypatch.setenv("CONCENT_MAX_DOCUMENT_BYTES", "1000")
    path = tmp_path / f"file{suffix}"
    path.write_text(" " * 1001)
    assert "CONCENT_MAX_DOCUMENT_BYTES higher" in refusal(read, path)


@pytest.mark.parametrize("value", ["", "many", "-1", "0", "nan", "inf"])
def test_a_limit_that_is_no_number_above_0_is_ignored(tmp_path, monkeypatch, value):
    monkeypatch.setenv("CONCENT_MAX_DOCUMENT_BYTES", value)
    (tmp_path / "a.json").write_text("[1, 2]")
    assert read_json(tmp_path / "a.json") == [1, 2]
