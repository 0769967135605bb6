"""edgevpr on an emulated ARM board: what needs no emulator."""

import os
import subprocess
import sys
from pathlib import Path

import on_arm64
from base import REPOSITORY


def test_without_its_tools_a_sentence_says_what_to_install():
    argv, env = [sys.executable, on_arm64.__file__], {**os.environ, "PATH": "", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(argv, env=env, capture_output=True, text=True)
    assert (done.returncode, done.stderr.partition(":")[0]) == (1, "on_arm64")
    assert "qemu-user-static" in done.stderr


def test_the_core_is_there():
    assert all((REPOSITORY / name).exists() for name in on_arm64.CORE)


def test_tests_are_counted_by_part(tmp_path):
    (tmp_path / "test_a.py").write_text(
        "import pytest\n"
        "def test_right(): pass\n"
        "def test_wrong(): assert False\n"
        "def test_skipped(): pytest.skip('no camera')\n"
        "def test_error(none_such): pass\n"
    )
    (tmp_path / "test_b.py").write_text("import os\ndef test_crash(): os.abort()\n")
    found = on_arm64.run_tests(Path(sys.executable), tmp_path, dict(os.environ), ("test_a.py", "test_b.py"))
    counts = [[row[key] for key in ("passed", "failed", "skipped")] for row in found["rows"].values()]
    assert counts == [[1, 2, 1], [0, 1, 0]]
    assert sorted(found["failed"]) == ["test_a.test_error", "test_a.test_wrong", "test_b.test_crash"]
    assert found["skipped"] == {"no camera": 1}
