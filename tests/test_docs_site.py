"""The documentation site builds without warnings, stands alone, and has every public name; its notebook runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import concent_warp as cw

REFERENCE = re.compile(r"^::: concent_warp\.(\w+)$", re.MULTILINE)


class Page(HTMLParser):
    """What a page loads, where it leads to, and which places it has."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.places: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.places |= {found.get("id", ""), found.get("name", "")}
        if tag == "a" and "href" in found:
            self.linked.append(found["href"])
        elif tag in ("script", "img", "iframe", "source") and "src" in found:
            self.loaded.append(found["src"])
        elif tag == "link" and found.get("rel") in ("stylesheet", "icon", "preconnect", "preload"):
            self.loaded.append(found["href"])


@pytest.fixture(scope="module")
def site(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the site, built as `make docs` builds it."""
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(["make", "-s", "layout"], cwd=root, check=True, timeout=60)
    mkdocs = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(mkdocs, cwd=root, env=environment, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    """Return the pages of the site."""
    return {path: Page(path) for path in site.rglob("*.html")}


def test_reference_shows_each_name_that_it_lists(root, site, pages):
    listed = [path for path in (root / "docs" / "api").glob("*.md") if path.stem != "index"]
    assert len(listed) >= 10
    for path in listed:
        page = pages[site / "api" / f"{path.stem}.html"]
        for name in REFERENCE.findall(path.read_text()):
            assert f"concent_warp.{cw._MODULE_OF[name]}.{name}" in page.places, name


def test_functions_are_shown_with_their_parameters_and_settings_with_their_fields(site):
    text = (site / "api" / "training.html").read_text()
    assert "concent_warp.train.cfg.PpoCfg.epochs" in text
    shown = re.sub(r"<[^>]+>", "", text)
    assert re.search(r"train\(\s*model: Model,", shown)


def test_pages_load_nothing_from_elsewhere(pages):
    assert len(pages) > 50
    for path, page in pages.items():
        assert [url for url in page.loaded if re.match(r"(\w+:)?//", url)] == [], path.name
        styles = re.findall(r"@import[^;]*//[^;]*|url\(['\"]?(?:https?:)?//[^)]*\)", path.read_text())
        assert styles == [], path.name


def test_links_within_the_site_lead_to_pages_and_places(pages):
    for path, page in pages.items():
        if path.name == "404.html":
            continue
        for url in [*page.linked, *page.loaded]:
            if re.match(r"(\w+:|//)", url):
                continue
            target, _, place = unquote(url).partition("#")
            file = (path.parent / target.partition("?")[0]).resolve() if target else path
            file = file / "index.html" if file.is_dir() else file
            assert file.is_file(), (path.name, url)
            if place and file.suffix == ".html":
                assert place in pages[file].places | {"__top"}, (path.name, url)


def test_notebook_finds_the_effect_and_the_error_falls_to_the_noise(site):
    text = re.sub(r"<[^>]+>", "", (site / "notebooks" / "hidden_effect.html").read_text())
    assert "Missing: joint_friction" in text
    (value,) = re.findall(r"torque\[hinge\] = ([\d.]+) \[", text)
    assert float(value) == pytest.approx(0.03, rel=0.02)
    assert "hinge_position: 7.2 -&gt; 1.0 x noise, fallen" in text
    assert (site / "notebooks" / "hidden_effect.html").read_text().count('src="data:image/png;base64') == 2
