"""Pictures of places and queries out of folders, small enough to stand inside a page."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.review.html import address_of


class Album:
    """Folders in which pictures are looked for by the names that the log gives them; `recorded` are those of a
    recording, by these names. A flight and the map it flies over each have one: pictures of both often have the same
    names. Raises UsageError for a folder that is not there."""

    def __init__(self, folders: Sequence[str | Path], recorded: Mapping[str, Path] = MappingProxyType({})) -> None:
        self._recorded = recorded
        self._folders = [Path(folder).resolve() for folder in folders]
        for given, folder in zip(folders, self._folders, strict=True):
            if not folder.is_dir():
                raise UsageError(f"{given}: there is no such folder: give one that holds pictures.")

    def picture(self, name: str | None) -> str | None:
        """Return a picture as an address that holds all of it (data:); None where there is none, or none that can be
        read."""
        if not name or not (self._folders or name in self._recorded):
            return None
        from edgevpr.frames.images import EXTENSIONS, read_image, small_jpeg  # a page without pictures needs no OpenCV

        if path := self._recorded.get(name):
            with suppress(ImageError):
                return address_of(small_jpeg(read_image(path)))
        for folder in self._folders:
            for ending in ("", *EXTENSIONS):
                try:
                    path = (folder / f"{name}{ending}").resolve()
                    # A log of somebody else may name any file of this machine: only what is in the folder is shown.
                    if not path.is_relative_to(folder) or not path.is_file():
                        continue
                    jpeg = small_jpeg(read_image(path))
                except (ImageError, OSError, ValueError):  # no picture, or a name that no file can have
                    continue
                return address_of(jpeg)
        return None
