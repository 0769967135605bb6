"""The page of a flight: what it says, and that it needs nothing else."""

import base64

import cv2
import numpy as np
import pytest
from browser import read_page_data
from commands import expect_refusal, run
from logs import query, write_log

from edgevpr.review.album import Album, make_album
from edgevpr.review.logged import read_flight
from edgevpr.review.page import make_flight_page

HTML = "<script>alert(1)</script>\"'><img src=http://example.test/x.png>\x1b\u202e\ud800"


def make_page(path):
    return make_flight_page(read_flight(path), [], Album(), Album())


@pytest.fixture(scope="module")
def report_page(flight_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "report.html"
    folders = ["--images", flight_folder / "seen", "--map-images", flight_folder / "ref"]
    assert run("report", flight_folder / "flight.jsonl", "--out", out, *folders) == 0
    return out


def test_make_flight_page_of_a_real_flight_has_all_parts(report_page):
    data = read_page_data(report_page.read_text("utf-8"))
    assert "longest time without a match" in dict(data["figures"])
    assert {"places", "accepted", "taken", "autopilot", "gps"} <= {each["colour"] for each in data["ground"]["layers"]}
    drawn = [chart["title"] for chart in data["charts"] if any(points for *_, points in chart["series"])]
    assert drawn[:5] == ["Confidence", "Position", "Time per query", "RAM", "Charge"]
    assert [count for name, _, count in data["groups"] if " 15 m " in name] == [8]
    assert data["warnings"] == [], "nothing is missing"


def test_flight_page_shows_query_and_match_side_by_side_though_their_pictures_have_one_name(report_page, flight_folder):
    data = read_page_data(report_page.read_text("utf-8"))
    (seen_as, seen), (found_as, found) = (
        (caption, cv2.imdecode(np.frombuffer(base64.b64decode(data["pictures"][at].partition(",")[2]), np.uint8), 0))
        for caption, at in data["steps"][2]["pictures"]
    )
    assert seen_as == "query: 2.png"
    assert found_as.endswith(": 2.png")
    assert abs(seen.mean() - cv2.imread(str(flight_folder / "seen" / "2.png"), 0).mean()) < 2
    assert abs(found.mean() - cv2.imread(str(flight_folder / "ref" / "2.png"), 0).mean()) < 2
    assert abs(seen.astype(int) - found).mean() > 20


def test_make_album_finds_only_images_in_the_given_folders(tmp_path):
    folder = tmp_path / "given"
    folder.mkdir()
    cv2.imwrite(str(tmp_path / "secret.png"), np.full((20, 20), 90, np.uint8))
    cv2.imwrite(str(folder / "one.png"), np.full((20, 20), 90, np.uint8))
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    album = make_album([folder])
    assert album.find_image("one.png") is not None
    for name in ("../secret.png", str(tmp_path / "secret.png"), "broken.png", "a\0b", "\ud800", "x" * 5000, ""):
        assert album.find_image(name) is None


def test_flight_page_treats_names_in_the_log_as_text(tmp_path):
    reason = {"code": "UNUSABLE", "parameters": {"problem": HTML}}
    nasty = query(HTML, reason=reason, reference_image=HTML, accepted=False)
    log = write_log(tmp_path / "log", ("query", nasty), ("query", query("b")), ("camera", {"said": HTML}))
    content = make_page(log)
    assert content.count("<script") == 2, "the data and the script of the page"
    assert "<img" not in content
    assert "<script>alert(1)</script>" in read_page_data(content)["steps"][0]["title"]
    assert not {"\x1b", "\u202e"} & set(content)


def test_flight_page_keeps_positions_across_the_date_line_together(tmp_path):
    at = [{"position": None, "fix": None, "located": {"lat_deg": 0.0, "lon_deg": lon}} for lon in (179.999, -179.999)]
    data = read_page_data(make_page(write_log(tmp_path / "log", *(("query", query("a", **each)) for each in at))))
    assert data["ground"]["box"][2] == pytest.approx(222.6 + 2 * 30, rel=0.01)


def test_report_writes_a_page_without_the_map(flight_folder, tmp_path):
    log = write_log(tmp_path / "log", ("start", {"map": str(tmp_path / "gone.gpkg")}), ("query", query("a")))
    assert run("report", log, "--out", tmp_path / "out.html") == 0
    data = read_page_data((tmp_path / "out.html").read_text("utf-8"))
    assert "not drawn" in data["warnings"][-1]
    assert data["ground"]["layers"]
    assert run("report", log, "--out", tmp_path / "out.html", "--map", flight_folder / "map.gpkg") == 0
    data = read_page_data((tmp_path / "out.html").read_text("utf-8"))
    assert data["ground"]["layers"][0]["colour"] == "places"


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        (["LOG", "--out", "LOG"], 2, "another output"),
        (["LOG", "--out", "no/such/out.html"], 2, "its folder"),
        (["gone", "--out", "out.html"], 2, "gone"),
        (["LOG", "--out", "out.html", "--map", "gone.gpkg"], 1, "gone.gpkg"),
        (["LOG", "--out", "out.html", "--images", "gone"], 2, "gone"),
        (["empty", "--out", "out.html"], 1, "empty"),
    ],
)
def test_report_refuses_an_impossible_request_in_one_sentence(tmp_path, monkeypatch, capsys, argv, code, said):
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "LOG", ("query", query("a")))
    (tmp_path / "empty").touch()
    before = (tmp_path / "LOG").read_bytes()
    assert said in expect_refusal(capsys, "report", *argv, code=code)
    assert (tmp_path / "LOG").read_bytes() == before
    assert not (tmp_path / "out.html").exists()
