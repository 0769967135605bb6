"""What the tests of this room share: trees of files that stand for a machine's /proc and /sys."""

import pytest


@pytest.fixture
def tree(tmp_path):
    """Write files below a root: tree({"proc/meminfo": "..."}) -> the root. Further calls change and add files."""

    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write
