"""Files of foreign origin: only files are opened, none larger than expected, and none is waited for."""

import os
import tracemalloc

import pytest

from edgevpr.core.files import open_file, read_file


def test_read_file_reads_all(tmp_path):
    (tmp_path / "a").write_bytes(b"abc" * 1000)
    assert read_file(tmp_path / "a", 3000) == b"abc" * 1000
    (tmp_path / "empty").touch()
    assert read_file(tmp_path / "empty", 3000) == b""
    assert b"Linux" in read_file("/proc/version", 3000)  # which says that it has no bytes


def test_read_file_refuses_a_file_that_is_too_large(tmp_path):
    (tmp_path / "a").write_bytes(bytes(3001))
    with pytest.raises(OSError, match="MB"):
        read_file(tmp_path / "a", 3000)


def test_read_file_allocates_no_more_than_the_file_has(tmp_path):
    (tmp_path / "a").write_bytes(bytes(5000))
    tracemalloc.start()
    try:
        read_file(tmp_path / "a", 1_000_000_000)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/null", "pipe"])
def test_open_file_refuses_pipes_and_devices(path, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="pipe"):
        open_file(tmp_path / path, 3000)  # an absolute path stays one
    assert len(os.listdir("/proc/self/fd")) == before
