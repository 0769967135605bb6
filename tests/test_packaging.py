"""The wheel: pure Python, complete, and at work without the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built without a network by the backend that pyproject.toml names."""
    pytest.importorskip("hatchling", reason="hatchling is not installed (pip install -e '.[dev]')")
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_has_profiles_models_and_deployment_files(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for kind in ("profiles", "models", "deploy"):
        there = [path for path in (ROOT / kind).rglob("*") if path.is_file() and path.parent.name != "__pycache__"]
        at_home = {path.relative_to(ROOT).as_posix() for path in there if path.parent.name != "recipes"}
        assert at_home == {name.removeprefix("edgevpr/shipped/") for name in names if f"/shipped/{kind}/" in name}
    assert "edgevpr/shipped/deploy/config.yaml" in names
    assert "edgevpr/shipped/deploy/edgevpr.service" in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_wheel_is_pure_python_with_every_module_and_nothing_else(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    code = {path.relative_to(ROOT).as_posix() for path in (ROOT / "edgevpr").rglob("*.py")}
    figures = {f"edgevpr/runtime/preflight/{name}.json" for name in ("accuracy", "counted")}
    looks = {"edgevpr/py.typed", "edgevpr/review/page.css", "edgevpr/review/page.js"}
    assert {name for name in names if not name.startswith("edgevpr/shipped/")} == code | figures | looks


def test_wheel_works_without_the_checkout(wheel, tmp_path):
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--disable-pip-version-check"]
    subprocess.run([*pip, "--target", site, wheel], capture_output=True, check=True)
    script = (
        "import edgevpr; from edgevpr.core.config import load_config; from edgevpr.power.boards import load_board\n"
        "from edgevpr.runtime.service.unit import render_unit\n"
        "print(edgevpr.__file__, load_config(None).battery.pack, 'MemoryMax=' in render_unit(load_board('rpi-5')))"
    )
    environment = os.environ | {"PYTHONPATH": str(site)}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=elsewhere, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(site / "edgevpr" / "__init__.py"), "4S5200", "True"]
