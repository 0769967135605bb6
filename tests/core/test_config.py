"""The configuration: one default for each key, explained by the file that is shipped."""

import re
from pathlib import Path

import pytest

from edgevpr.core.config import Config, build, list_keys, load_config
from edgevpr.core.errors import ConfigError
from edgevpr.core.yamlfile import read_yaml

SHIPPED = Path(__file__).parents[2] / "deploy" / "config.yaml"


def read_comments() -> dict[str, str]:
    """The comment above each key of the shipped file, by the key's dotted name; keys in a row share one."""
    found, comment, section, is_new = {}, "", "", True
    for line in SHIPPED.read_text("utf-8").splitlines():
        if text := re.match(r" *# ?(.*)", line):
            comment, is_new = (text[1] if is_new else f"{comment} {text[1]}"), False
        elif name := re.match(r"( *)(\w+):( .*)?", line):
            found[f"{section}{name[2]}" if name[1] else name[2]] = comment
            section, is_new = (section if name[1] or name[3] else f"{name[2]}."), True
    return found


def test_config_file_holds_the_default_of_every_key():
    assert build(Config, read_yaml(SHIPPED), str(SHIPPED)) == Config()
    assert {key.name.removesuffix(".gps").removesuffix(".no_gps") for key in list_keys()} <= read_comments().keys()


def test_config_file_documents_the_limits_of_every_key():
    texts, unsaid = read_comments(), []
    for key in (key for key in list_keys() if key.limits):
        limits = " to ".join(f"{limit:.12g}" for limit in key.limits)
        if limits not in (texts.get(key.name) or texts[key.name.rpartition(".")[0]]):
            unsaid.append(f"{key.name}: {limits}")
    assert not unsaid


def test_load_config_puts_flags_over_the_file_over_the_defaults(tmp_path):
    path = tmp_path / "flight.yaml"
    path.write_text("source: {rate_hz: 4, up_deg: 90}\n")
    config = load_config(path, {"source.rate_hz": 2.0, "mavlink.source_sets.gps": 1, "map": None})
    assert (config.source.rate_hz, config.source.up_deg, config.source.gimbal) == (2.0, 90.0, False)
    assert (config.mavlink.source_sets.gps, config.map) == (1, None)


def test_load_config_refuses_an_invalid_section_before_applying_a_flag(tmp_path):
    path = tmp_path / "flight.yaml"
    path.write_text("source:\n")
    with pytest.raises(ConfigError, match="`source`"):
        load_config(path, {"source.rate_hz": 2.0})
