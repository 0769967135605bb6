"""What is imported when, and which room may import which."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_the_command_line_imports_nothing_heavy_before_it_knows_what_is_asked():
    script = "import sys, edgevpr.cli; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "edgevpr.cli" in loaded
    assert not loaded & {"av", "cv2", "numpy", "onnxruntime", "pymavlink", "yaml", "psutil", "serial"}


@pytest.mark.slow
def test_imports_run_one_way():
    lint_imports = Path(sys.executable).with_name("lint-imports")
    if not lint_imports.exists():
        pytest.skip("import-linter is not installed beside this Python (pip install -e '.[dev]')")
    done = subprocess.run([lint_imports, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
