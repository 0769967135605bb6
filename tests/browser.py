"""Headless Chromium, where it is installed."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
OWN = "not an origin"  # begins a request of the browser itself, which looks for updates


@dataclass(frozen=True)
class Shown:
    """A page as a browser has shown it: its content in the end, what stands in the console, and what it asked for."""

    content: str
    console: list[str]
    requests: list[str]


def installed() -> str:
    """The path of the browser; skips the test where there is none."""
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f"no browser is installed ({', '.join(NAMES)})")
    return browser


@contextmanager
def driven() -> Iterator[Any]:
    """A browser of Playwright, to be driven; skips the test where there is none."""
    playwright = pytest.importorskip("playwright.sync_api")
    path = installed()
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


def show(page: Path, width_px: int = 1200) -> Shown:
    """Show a page; skip the test where there is no browser."""
    browser = installed()
    folder = page.parent / f"{page.stem}-browser"
    net = folder / "net.json"
    folder.mkdir(exist_ok=True)
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
    flags += ["--enable-logging=stderr", f"--user-data-dir={folder / 'profile'}", f"--log-net-log={net}"]
    flags += [f"--window-size={width_px},900", "--dump-dom", page.as_uri()]
    done = subprocess.run([browser, *flags], capture_output=True, text=True, errors="replace", timeout=120)
    assert done.returncode == 0, done.stderr
    started = [event.get("params") for event in json.loads(net.read_text("utf-8"))["events"]]
    asked = [each for each in started if isinstance(each, dict) and each.keys() >= {"url", "initiator"}]
    return Shown(
        content=done.stdout,
        console=[line for line in done.stderr.splitlines() if ":CONSOLE" in line],
        requests=[each["url"] for each in asked if each["initiator"] != OWN],
    )


class Opened:
    """A page that is open, for `with`; at its end nothing may have been asked for, and nothing complained of."""

    def __init__(self, browser, path, width_px=390):
        self._browser, self._path, self._width_px = browser, path, width_px

    def __enter__(self):
        self._context = self._browser.new_context(viewport={"width": self._width_px, "height": 800})
        page, self._said = self._context.new_page(), []
        page.on("console", lambda message: self._said.append(message.text))
        page.on("pageerror", lambda error: self._said.append(str(error)))
        page.on("request", lambda asked: self._said.append(asked.url) if asked.url.startswith("http") else None)
        page.goto(self._path.as_uri())
        return page

    def __exit__(self, *_):
        self._context.close()
        assert not self._said
