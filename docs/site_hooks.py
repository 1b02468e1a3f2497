"""Hooks of the documentation site: linked files of the repository, public names, and the list of benchmarks.

The pages' links are relative, so that they hold in a clone as well. A file outside docs/ becomes a page of the site.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from posixpath import normpath, relpath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

LINK = re.compile(r"(\]\()([^)#:\s]+)(\)|#)")
REFERENCE = re.compile(r"^::: concent_warp\.(\w+)$", re.MULTILINE)
COPIES = "repository/"
"""Folder of the site for files outside docs/."""
LANGUAGES = {".py": "python", ".toml": "toml", ".yml": "yaml", ".xml": "xml", ".json": "json", "": "makefile"}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Return the configuration with the pages of a folder in place of the folder's name in the navigation."""
    for part in config.nav or []:
        for title, value in part.items() if isinstance(part, dict) else ():
            if isinstance(value, str) and value.endswith("/"):
                part[title] = _pages(Path(config.docs_dir), value)
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Return the files of the site with those of the repository that pages link to."""
    docs = Path(config.docs_dir)
    pages = [file for file in files if file.src_uri.endswith(".md")]
    while pages:
        page = pages.pop()
        for _, target, _ in LINK.findall(page.content_string):
            path = _linked(docs, page.src_uri, target)
            if path and not path.is_relative_to(docs) and files.get_file_from_path(_uri(docs, path)) is None:
                pages.append(File.generated(config, _uri(docs, path), content=_content(docs, path)))
                files.append(pages[-1])
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """Return the text of a page: links to files outside docs/ lead to their pages, public names to where they are."""
    docs, uri = Path(config.docs_dir), page.file.src_uri
    homes = _homes(docs.parent / "concent_warp" / "__init__.py")

    def reference(found: re.Match[str]) -> str:
        name = found[1]
        return f"::: concent_warp.{homes[name]}.{name}\n    options: {{heading: {name}, toc_label: {name}}}"

    def target(found: re.Match[str]) -> str:
        path = _linked(docs, uri, found[2])
        return found[1] + relpath(_uri(docs, path), str(Path(uri).parent)) + found[3] if path else found[0]

    return LINK.sub(target, REFERENCE.sub(reference, markdown))


def _pages(docs: Path, folder: str) -> list[str]:
    """Return the pages of a folder by name, the index first."""
    found = sorted(path.relative_to(docs).as_posix() for path in (docs / folder).glob("*.md"))
    return sorted(found, key=lambda uri: not uri.endswith("/index.md"))


def _homes(front_door: Path) -> dict[str, str]:
    """Return the module of each public name: some share theirs with a module, which would be documented instead."""
    assigned = {
        node.targets[0].id: node.value
        for node in ast.parse(front_door.read_text()).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    homes = eval(compile(ast.Expression(assigned["_HOMES"]), str(front_door), "eval"), {})
    return {name: module for module, names in homes.items() for name in names}


def _linked(docs: Path, uri: str, target: str) -> Path | None:
    """Return the file of the repository that a link of a page leads to, None where there is none."""
    folder = (docs.parent / uri.removeprefix(COPIES) if uri.startswith(COPIES) else docs / uri).parent
    path = Path(normpath(folder / target))
    return path if path.is_relative_to(docs.parent) and path.is_file() else None


def _uri(docs: Path, path: Path) -> str:
    """Return the place in the site of a file of the repository."""
    if path.is_relative_to(docs):
        return path.relative_to(docs).as_posix()
    return f"{COPIES}{path.relative_to(docs.parent).as_posix().removesuffix('.md')}.md"


def _content(docs: Path, path: Path) -> str:
    """Return the page of a file of the repository: its text, or its code."""
    text = path.read_text()
    if path.suffix == ".md":
        return text
    name = path.relative_to(docs.parent).as_posix()
    return f"# {name}\n\n````{LANGUAGES.get(path.suffix, 'text')}\n{text}````\n"
