"""A disk that is full, for this process."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def limit_file_size(limit_bytes: int) -> Iterator[None]:
    """Writes past the limit fail, and the one that crosses it is cut. Python ignores the signal that comes with it.

    Where a command prints, its output must be captured in memory (`capsys`): pytest's own capture is a file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
