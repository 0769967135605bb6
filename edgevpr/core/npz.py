"""Archives of arrays (.npz) that somebody else may have written."""

import io
import zipfile

import numpy as np


def arrays_of(content: bytes, most_bytes: int) -> dict[str, np.ndarray]:
    """Unpack an archive to its arrays by name. Raises ValueError for one that is damaged, holds objects of Python, or
    takes more than `most_bytes` unpacked."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(part.file_size for part in archive.infolist()) > most_bytes:
                raise ValueError(f"it takes more than {most_bytes / 1e6:.0f} MB unpacked")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (OSError, EOFError, KeyError, MemoryError, NotImplementedError, zipfile.BadZipFile) as error:
        raise ValueError(str(error)) from error
