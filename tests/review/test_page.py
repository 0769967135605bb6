"""The page of a flight: what it says, and that it needs nothing else."""

import base64
import re

import cv2
import numpy as np
import pytest
from browser import Opened
from logs import query, write_log

from edgevpr.cli.main import main
from edgevpr.review.album import Album
from edgevpr.review.logged import read_flight
from edgevpr.review.page import page_of

NO_PICTURES = Album([])
NASTY = "<script>alert(1)</script>\"'><img src=http://example.test/x.png>\x1b\u202e\ud800"


def page(path):
    return page_of(read_flight(path), [], NO_PICTURES, NO_PICTURES)


def report(capsys, *argv):
    """What the command says, and its exit code."""
    code = main(["report", *map(str, argv)])
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return code, (said.out + said.err).strip()


def pictures(made):
    """Pictures of a page by what stands below them."""
    found = re.findall(r'src="data:image/jpeg;base64,([^"]*)"><figcaption>([^<]*)<', made)
    return {said: cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), 0) for data, said in found}


@pytest.fixture(scope="module")
def made(flown, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "report.html"
    folders = ["--images", flown / "seen", "--map-images", flown / "ref"]
    assert main(["report", *map(str, [flown / "flight.jsonl", "--out", out, *folders])]) == 0
    return out


@pytest.mark.process
@pytest.mark.slow
def test_a_page_of_a_real_flight_has_all_parts(made):
    content = made.read_text("utf-8")
    for part in ("Over the ground", "every query", "Over time", "Worst moments", "Why matches were refused"):
        assert part in content
    for drawn in ("layer-places", "layer-accepted", "layer-taken", "line autopilot", "line gps"):
        assert drawn in content, drawn
    for chart in ("Confidence", "Position", "A query", "RAM", "Charge"):
        assert f"<b>{chart}</b>" in content
    assert "90 m from" in content
    assert "notes" not in re.findall(r'<section class="(\w+)"', content), "nothing is missing"


def test_query_and_match_stand_side_by_side_though_their_pictures_have_one_name(made, flown):
    shown = pictures(made.read_text("utf-8"))
    name = next(said.removeprefix("seen: ") for said in shown if said.startswith("seen: "))
    seen, found = shown[f"seen: {name}"], shown[f"place found: {name}"]
    assert abs(seen.mean() - cv2.imread(str(flown / "seen" / name), 0).mean()) < 2
    assert abs(found.mean() - cv2.imread(str(flown / "ref" / name), 0).mean()) < 2
    assert abs(seen.astype(int) - found).mean() > 20


def test_only_pictures_of_the_folders_that_are_given_are_shown(tmp_path):
    folder = tmp_path / "given"
    folder.mkdir()
    cv2.imwrite(str(tmp_path / "secret.png"), np.full((20, 20), 90, np.uint8))
    cv2.imwrite(str(folder / "one.png"), np.full((20, 20), 90, np.uint8))
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    album = Album([folder])
    assert album.picture("one.png")
    for name in ("../secret.png", str(tmp_path / "secret.png"), "broken.png", "a\0b", "\ud800", "x" * 5000, "", None):
        assert album.picture(name) is None


def test_names_in_the_log_are_text_and_nothing_else(tmp_path):
    nasty = query(NASTY, reason=NASTY, reference_image=NASTY, accepted=False)
    log = write_log(tmp_path / "log", ("query", nasty), ("query", query("b")), ("camera", {"said": NASTY}))
    content = page(log)
    assert content.count("<script") == 2, "the data and the script of the page"
    assert "<img" not in content
    assert "&lt;script&gt;" in content
    assert not {"\x1b", "\u202e"} & set(content)


@pytest.mark.parametrize(
    ("lines", "end", "said"),
    [
        ([], True, "No picture became a query"),
        ([("unusable", {"problem": "cut short"})], True, "No picture became a query"),
        ([("query", query("a", located=None, position=None, fix=None))], True, "No place has a position"),
        ([("query", query("a"))], False, "has no last line: it was cut off"),
        ([("query", query("a"))], True, "no report of the autopilot"),
    ],
)
def test_a_page_says_what_is_missing(tmp_path, lines, end, said):
    content = page(write_log(tmp_path / "log", *lines, end=end))
    assert said in content
    assert ("Over the ground" in content) == any(fields.get("position") for _, fields in lines)


def test_the_worst_moments_are_those_that_could_be_dangerous(tmp_path):
    vehicle = {"lat_deg": 50.0, "lon_deg": 8.0, "t_heard_s": 1010.0, "velocity_m_s": [0.0, 0.0]}
    gps = {"lat_deg": 50.001, "lon_deg": 8.0, "sd_m": 1.0, "t_s": 1010.0}
    refused = query("denied") | {"fix": query("denied")["fix"] | {"answer": "DENIED", "why": "in use"}}
    nothing = [("query", query("lost", accepted=False, located=None, fix=None, t_mono_s=1100.0 + t)) for t in range(20)]
    lines = [
        ("query", query("usual", t_mono_s=1002.0)),
        ("query", query("far", t_mono_s=1010.0, t_frame_s=1010.0, vehicle=vehicle | {"gps": gps})),
        ("query", refused | {"t_mono_s": 1050.0}),
        *nothing,
    ]
    content = page(write_log(tmp_path / "log", *lines))
    why = re.findall(r'<h3><i>\d</i>([^<]*)</h3><p class="soft">(\w+):', content)
    assert [name for _, name in why][:3] == ["far", "denied", "lost"]
    assert "111 m from GPS" in why[0][0]
    assert "in use" in why[1][0]
    assert "20 queries" in why[2][0]


def test_positions_that_cross_the_date_line_stay_together(tmp_path):
    at = [{"position": None, "fix": None, "located": {"lat_deg": 0.0, "lon_deg": lon}} for lon in (179.999, -179.999)]
    lines = [("query", query("a", **each)) for each in at]
    assert "50 m" in re.search(r'class="ruler"[^>]*>([^<]*)<', page(write_log(tmp_path / "log", *lines)))[1]


def test_a_map_that_is_not_there_is_no_reason_to_have_no_page(flown, tmp_path, capsys):
    log = write_log(tmp_path / "log", ("start", {"map": str(tmp_path / "gone.gpkg")}), ("query", query("a")))
    code, _ = report(capsys, log, "--out", tmp_path / "out.html")
    content = (tmp_path / "out.html").read_text("utf-8")
    assert code == 0
    assert "not drawn" in content
    assert "layer-" in content
    code, _ = report(capsys, log, "--out", tmp_path / "out.html", "--map", flown / "map.gpkg")
    assert "layer-places" in (tmp_path / "out.html").read_text("utf-8")
    assert code == 0


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        (["LOG", "--out", "LOG"], 2, "give another name"),
        (["LOG", "--out", "no/such/out.html"], 2, "there is no such folder: make it first"),
        (["gone", "--out", "out.html"], 2, "there is no such flight log"),
        (["LOG", "--out", "out.html", "--map", "gone.gpkg"], 1, "There is no map"),
        (["LOG", "--out", "out.html", "--images", "gone"], 2, "there is no such folder"),
        (["empty", "--out", "out.html"], 1, "holds no line of a flight log"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_sentence(tmp_path, monkeypatch, capsys, argv, code, said):
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "LOG", ("query", query("a")))
    (tmp_path / "empty").touch()
    before = (tmp_path / "LOG").read_bytes()
    got, sentence = report(capsys, *argv)
    assert (got, said in sentence) == (code, True), sentence
    assert (tmp_path / "LOG").read_bytes() == before
    assert not (tmp_path / "out.html").exists()


@pytest.mark.process
@pytest.mark.slow
def test_the_page_judges_a_real_flight_as_it_was_judged_and_asks_for_nothing(made, browser):
    with Opened(browser, made) as page:
        said = page.inner_text("#would")
    assert said.startswith("0 more accepted, 0 fewer, of ")
    assert "of 0 that" not in said
