"""Headless Chromium, where it is installed."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


@contextmanager
def driven() -> Iterator[Any]:
    """A browser of Playwright, to be driven; skips the test where there is none."""
    playwright = pytest.importorskip("playwright.sync_api")
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser is installed ({', '.join(NAMES)})")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


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
