"""What is imported when."""

import subprocess
import sys


def test_the_command_line_imports_nothing_heavy_before_it_knows_what_is_asked():
    script = "import sys, edgevpr.cli; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "edgevpr.cli" in loaded
    assert not loaded & {"av", "cv2", "numpy", "onnxruntime", "pymavlink", "yaml", "psutil", "serial"}
