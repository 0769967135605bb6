"""Headless Chromium, where it is installed."""

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
OWN = "not an origin"  # begins a request of the browser itself, which looks for updates


@dataclass(frozen=True)
class Shown:
    """A page as a browser has shown it: its content in the end, what stands in the console, and what it asked for."""

    content: str
    console: list[str]
    requests: list[str]


def show(page: Path, width_px: int = 1200) -> Shown:
    """Show a page; skip the test where there is no browser."""
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f"no browser is installed ({', '.join(NAMES)})")
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
