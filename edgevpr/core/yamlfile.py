"""Reads untrusted YAML files; the only module that imports PyYAML. Aliases and duplicate keys are errors, so time and
memory grow only with the length of the file, which is limited."""

from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from edgevpr.core.errors import ConfigError
from edgevpr.core.files import read_file

MAX_FILE_BYTES = 100_000  # the longest shipped file has 6,000; PyYAML reads about 100,000 bytes a second


class _StrictLoader(yaml.SafeLoader):
    """Loader that rejects aliases and duplicate keys."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]  # PyYAML
        if isinstance(event, yaml.AliasEvent):
            raise _make_error(f"alias `*{event.anchor}` is not allowed: write out its value", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in lines:
                    raise _make_error(f"the key `{key.value}` is already in line {lines[key.value]}", key.start_mark)
                lines[key.value] = key.start_mark.line + 1
        return super().construct_mapping(node, deep)


def _make_error(problem: str, mark: Any) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, mark)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML mapping; {} for an empty file. Raises ConfigError for a file that is missing, unreadable, too large
    or not a mapping, for a duplicate key, and for an alias (`*name`), which can make a small file expand hugely."""
    try:
        data = read_file(path, MAX_FILE_BYTES)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}): pass the path of a YAML file.") from error
    return parse_yaml(data, path)


def parse_yaml(data: bytes, path: str | Path) -> dict[str, Any]:
    """Parse the bytes of the YAML file `path`; raises ConfigError as `read_yaml` does."""
    try:
        content = deepcopy(_load(data.decode("utf-8-sig")))
    # An impossible date or a number of 5000 digits raises ValueError, deep nesting RecursionError.
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise ConfigError(f"{path}{where} is not valid YAML ({problem}): correct it.") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path} must contain `key: value` lines, not a {type(content).__name__}.")
    return content


# Commands read some files several times, mostly board profiles, and PyYAML needs 3 to 8 ms each on a workstation.
@lru_cache(maxsize=32)
def _load(text: str) -> Any:
    return yaml.load(text, _StrictLoader)
