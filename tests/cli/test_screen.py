"""Names, passwords and halves of characters on their way to the terminal."""

import logging
import sys

import cv2
import pytest
from pictures import draw_texture

from edgevpr.cli.main import main
from edgevpr.cli.screen import LineFormatter
from edgevpr.core.text import escape_unprintable, redact_passwords, sanitize

RED_ESCAPE_NAME = "\x1b[31m.jpg"  # a name that would make all that follows red


def capture_output(capfd, *words):
    """The exit code of a command, and all that it and its libraries print."""
    try:
        code = main([str(word) for word in words])
    except SystemExit as ended:
        code = ended.code
    return code, *capfd.readouterr()


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("Straße 東京.jpg", "Straße 東京.jpg"),
        ("a\x1b[31m\n\r\x07\x7f\x9b", r"a\x1b[31m\n\r\x07\x7f\x9b"),
        ("gpj.\u202e\u2028", r"gpj.\u202e\u2028"),
        ("caf\udce9", r"caf\xe9"),
        ("\ud800\0", r"\ud800\x00"),
    ],
)
def test_escape_unprintable_escapes_terminal_control_characters(text, printed):
    assert escape_unprintable(text) == printed
    printed.encode("utf-8")


@pytest.mark.parametrize(
    ("address", "without"),
    [
        ("rtsp://pilot:secret@10.0.0.2:554/cam", "rtsp://pilot:***@10.0.0.2:554/cam"),
        ("rtsp://:secret@10.0.0.2/cam", "rtsp://:***@10.0.0.2/cam"),
        ("rtsp://pilot:s/e:c@r@et@10.0.0.2/cam", "rtsp://pilot:***@10.0.0.2/cam"),
        ("http://10.0.0.2/cam?user=pilot&pwd=secret&x=1", "http://10.0.0.2/cam?user=pilot&pwd=***&x=1"),
        ("There is no map rtsp:/pilot:secret@cam.", "There is no map rtsp:/pilot:***@cam."),
        ("rtsp://10.0.0.2:554/cam", "rtsp://10.0.0.2:554/cam"),
        ("rtsp://pilot@10.0.0.2:554/cam", "rtsp://pilot@10.0.0.2:554/cam"),
        ("serial:/dev/ttyAMA0:921600", "serial:/dev/ttyAMA0:921600"),
    ],
)
def test_redact_passwords_replaces_them(address, without):
    assert redact_passwords(address) == without
    assert sanitize(f"{address} is lost, {address} is back") == f"{without} is lost, {without} is back"


def test_line_formatter_keeps_a_message_in_one_line():
    try:
        raise ValueError("rtsp://pilot:secret@cam\nINFO all is well")
    except ValueError:
        record = logging.LogRecord("x", 20, "x.py", 1, "bad\nINFO %s", ("\x1b[31m",), sys.exc_info())
    text = LineFormatter("edgevpr: %(message)s").format(record)
    assert text.startswith("edgevpr: bad\\nINFO \\x1b[31m\nTraceback")
    assert len(text.splitlines()) > 3


@pytest.mark.slow
def test_main_escapes_names_of_images(tmp_path, capfd):
    for number, folder in enumerate(("ref", "query")):
        (tmp_path / folder).mkdir()
        picture = cv2.imencode(".jpg", draw_texture(1, 120, 160))[1].tobytes()
        (tmp_path / folder / RED_ESCAPE_NAME).write_bytes(picture)
        (tmp_path / folder / f"{number}\x1b[0m.jpg").write_bytes(b"no image")
    flags = "--images", tmp_path / "ref", "--technique", "cohog"
    code, *built = capture_output(capfd, "map", "build", tmp_path / "m.gpkg", *flags)
    assert code == 1
    _, out, err = capture_output(capfd, "match", tmp_path / "m.gpkg", "--images", tmp_path / "query")
    assert "1\\x1b[0m.jpg" in err
    assert out.count("\\x1b[31m.jpg") == 2
    assert "\x1b" not in "".join([*built, out, err])


@pytest.mark.slow
def test_main_prints_no_password(tmp_path, capfd):
    (tmp_path / "c.yaml").write_text("source: {uri: 'http://pilot:secret@127.0.0.1:9/cam'}\n")
    _, *checked = capture_output(capfd, "check", "--config", tmp_path / "c.yaml")
    assert "http://pilot:***@127.0.0.1:9/cam" in checked[0]
    build = "map", "build", tmp_path / "m.gpkg", "--images", "rtsp://pilot:secret@127.0.0.1/cam"
    code, *refused = capture_output(capfd, *build)
    assert (code, "rtsp://pilot:***@127.0.0.1/cam" in refused[1]) == (1, True)
    assert "secret" not in "".join([*checked, *refused])


def test_main_escapes_a_wrong_flag(capfd):
    code, _, err = capture_output(capfd, "match", "m.gpkg", "--images", "x", "\x1b[31m")
    assert code == 2
    assert "\\x1b[31m" in err
    assert "\x1b" not in err
