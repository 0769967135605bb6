"""Headless Chromium, where it is installed, and the data of pages."""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


def read_page_data(content: str) -> Any:
    """The data of a page for its script."""
    return json.loads(re.search(r'id="page">(.*?)</script>', content)[1])


@contextmanager
def launch_browser() -> Iterator[Any]:
    """A browser of Playwright, to be driven; skips the test where there is none."""
    playwright = pytest.importorskip("playwright.sync_api")
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser is installed ({', '.join(NAMES)})")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@contextmanager
def open_page(browser: Any, path: Path, width_px: int = 390) -> Iterator[Any]:
    """A page that is open; at its end nothing may have been asked for, and nothing complained of."""
    context = browser.new_context(viewport={"width": width_px, "height": 800})
    page, said = context.new_page(), []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda asked: said.append(asked.url) if asked.url.startswith("http") else None)
    page.goto(path.as_uri())
    yield page
    context.close()
    assert not said
