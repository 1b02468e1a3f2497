"""A page in headless Chromium that stays open, driven over the browser's own protocol."""

import base64
import contextlib
import json
import os
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect
from websockets.sync.connection import Connection

BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--hide-scrollbars"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--window-size=1000,700", "--remote-debugging-port=0"),
]


class Page:
    """An open page."""

    def __init__(self, connection: Connection) -> None:
        self.connection, self.count = connection, 0
        self.messages: list[str] = []
        """Warnings and errors of its console, and exceptions."""

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.count += 1
        self.connection.send(json.dumps({"id": self.count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.connection.recv(timeout=60))
            if message.get("method") == "Runtime.exceptionThrown":
                self.messages.append(message["params"]["exceptionDetails"]["text"])
            if message.get("method") == "Runtime.consoleAPICalled" and message["params"]["type"] == "error":
                self.messages.append(json.dumps(message["params"]["args"]))
            if message.get("id") == self.count:
                return message["result"]

    def run(self, script: str) -> Any:
        """Return what a line of JavaScript comes to."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        return self.run("document.body.innerText") or ""

    def wait_for(self, pattern: str, seconds: float = 60) -> re.Match[str]:
        """Return where a pattern is in the page's text, once it is there."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (found := re.search(pattern, self.text())) is not None:
                return found
            time.sleep(0.1)
        raise AssertionError(f"{pattern} is not in the page: {self.text()}")

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


@contextlib.contextmanager
def opened(address: str, folder: Path) -> Iterator[Page]:
    """Give a page."""
    assert BROWSER is not None
    profile = folder / "profile"
    command = [BROWSER, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
    environment = {**os.environ, "HOME": str(folder)}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment) as b:
        try:
            assert b.stderr is not None
            port = next(m[1] for line in b.stderr if (m := re.search(r"DevTools listening on ws://[^:]*:(\d+)/", line)))
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
                target = next(t for t in json.load(answer) if t["type"] == "page")
            with connect(target["webSocketDebuggerUrl"], max_size=None, proxy=None) as connection:
                page = Page(connection)
                page.call("Runtime.enable")
                page.call("Page.enable")
                page.call("Page.navigate", url=address)
                yield page
        finally:
            b.terminate()
