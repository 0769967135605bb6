"""The errors that a user can see. Every message is one sentence that names the cause and says what to do."""


class EdgevprError(Exception):
    """Base class: something that the program needs (a file, a link, a map) cannot be used. Exit code 1."""

    exit_code = 1


class UsageError(EdgevprError):
    """The user's request (an option, a configuration key) is wrong. Exit code 2."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration, board or model file is missing or has invalid content."""


class ImageError(EdgevprError):
    """One image, or `count` images of a video, cannot be used; the others may be usable."""

    def __init__(self, message: str, count: int = 1) -> None:
        super().__init__(message)
        self.count = count


class SourceError(EdgevprError):
    """A source of frames cannot be opened."""


class MapError(EdgevprError):
    """A place map cannot be opened, written or used with this technique."""


class MapBusyError(MapError):
    """Another program is writing to the place map."""


class PlaceError(MapError):
    """One place of a map cannot be used; the others may be usable. `place_id`: the place's number in the map file
    `path`. `problem`: what is wrong, in a few words."""

    def __init__(self, path: object, place_id: int, problem: str) -> None:
        super().__init__(f"{path}: place {place_id} is damaged ({problem}): `edgevpr map check` lists all damage.")
        self.place_id, self.problem = place_id, problem


class LinkError(EdgevprError):
    """A MAVLink link cannot be opened."""


class LinkAddressError(LinkError):
    """The address of a MAVLink link is invalid, so retrying will not help. Exit code 2."""

    exit_code = 2


class ModelError(EdgevprError):
    """A network cannot be used. The cause is its card (the YAML file that describes it), its file, its output, the
    visual vocabulary trained with it, or onnxruntime."""
