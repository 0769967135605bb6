"""YAML of a hostile user: one sentence with file and line, no more time and memory than the file is long."""

import pytest

from edgevpr.core.config import load_config
from edgevpr.core.errors import ConfigError
from edgevpr.core.yamlfile import MAX_FILE_BYTES, read_yaml

ALIAS_BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{after}: &{after} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGE_BOMB = "a: &a {x0: 1}\n" + "".join(
    f"{after}: &{after}\n" + f"  <<: [{', '.join([f'*{before}'] * 10)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.fixture
def read_refusal(tmp_path):
    """The sentence with which a file is refused."""

    def refuse(content: str | bytes, read=read_yaml) -> str:
        path = tmp_path / "config.yaml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
        with pytest.raises(ConfigError) as raised:
            read(path)
        said = str(raised.value)
        assert said.startswith(str(path))
        assert len(said) < len(str(path)) + 400
        assert "\n" not in said
        return said

    return refuse


def test_read_yaml_names_both_lines_of_a_duplicate_key(read_refusal):
    said = read_refusal("source: {uri: a}\nmap: m.gpkg\nsource: {uri: b}\n")
    assert all(part in said for part in ("line 3", "`source`", "line 1"))
    assert "line 2" in read_refusal("source:\n  {uri: a, rate_hz: 1, uri: b}\n")
    assert "line 4" in read_refusal('match:\n  min_score: 0.5\n  form: float\n  "min_score": 0.6\n')


@pytest.mark.parametrize("content", [ALIAS_BOMB, MERGE_BOMB, "a: &a {b: *a}\n"])
def test_read_yaml_refuses_aliases(content, read_refusal):
    assert "alias `*a`" in read_refusal(content)


@pytest.mark.parametrize("level", ["[", "{a: ", "- ", "? "])
def test_read_yaml_refuses_deep_nesting(level, read_refusal):
    assert "valid YAML" in read_refusal(level * (MAX_FILE_BYTES // len(level) - 1))


@pytest.mark.parametrize(
    ("number", "says"),
    [
        ("9" * 400, "too many digits"),
        ("9" * 5000, "valid YAML"),  # which Python itself refuses
        ("0x" + "f" * 5000, "too many digits"),
        ("-1" + ":59" * 400, "too many digits"),
        ("1" + "0" * 30 + ".0", "`source.rate_hz` is 1e+30"),
        ("1.0e+400", "`source.rate_hz` is inf"),
        (".nan", "`source.rate_hz` is nan"),
    ],
)
def test_load_config_refuses_numbers_with_hundreds_of_digits(number, says, read_refusal):
    assert says in read_refusal(f"source: {{rate_hz: {number}}}\n", load_config)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (r'"a\0b"', "`map` contains a character"),
        (r'"\ud800"', "`map` contains a character"),
        ("[" + "x, " * 9000 + "x]", "`map` must be text"),
        ("2001-02-30", "valid YAML"),
        ("!!python/object/apply:os.system [id]", "valid YAML"),
        ("m.gpkg\n? " + "k" * 50_000 + "\n: 1", "key `kkkk"),
    ],
)
def test_load_config_refuses_characters_that_no_file_name_can_have(text, says, read_refusal):
    assert says in read_refusal(f"map: {text}\n", load_config)


def test_read_yaml_refuses_a_large_file(read_refusal):
    assert "0.1 MB" in read_refusal("# " + "x" * MAX_FILE_BYTES)


def test_read_yaml_returns_a_copy(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("source: {uri: a}\n")
    read_yaml(path)["source"]["uri"] = "b"
    assert read_yaml(path) == {"source": {"uri": "a"}}
    path.write_text("source: {uri: c}\n")
    assert read_yaml(path) == {"source": {"uri": "c"}}
