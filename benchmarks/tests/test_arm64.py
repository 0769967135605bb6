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
    files = on_arm64.core_files(REPOSITORY)
    assert len(files) == len(set(files)) > 30
    assert all((REPOSITORY / name).exists() for name in (*on_arm64.CORE, *files))


def test_the_tests_of_a_file_are_counted(tmp_path):
    (tmp_path / "test_a.py").write_text(
        "import pytest\n"
        "def test_right(): pass\n"
        "def test_wrong(): assert False\n"
        "def test_skipped(): pytest.skip('no camera')\n"
        "def test_error(none_such): pass\n"
    )
    (tmp_path / "test_b.py").write_text("import os\ndef test_crash(): os.abort()\n")
    found, crashed = (
        on_arm64.run_tests(Path(sys.executable), tmp_path, f"test_{x}.py", dict(os.environ)) for x in "ab"
    )
    assert (found["passed"], found["failed"]) == (1, ["test_a.test_wrong", "test_a.test_error"])
    assert found["skipped"] == {"test_a.test_skipped": "no camera"}
    assert (crashed["passed"], len(crashed["failed"])) == (0, 1)
