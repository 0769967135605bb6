"""The page as its reader moves it, in a real browser: slider, ground, filter, precision."""

import json
import re

import pytest
from browser import Opened
from ground import SURE, flown_over, places_in
from logs import query, write_log

from edgevpr.review.album import Album
from edgevpr.review.logged import read_flight, value
from edgevpr.review.matchpage import thresholds_of
from edgevpr.review.page import page_of

pytestmark = [pytest.mark.process, pytest.mark.slow]

COUNT = 30
NASTY = "</script><script>alert(1)</script><img src=http://example.test/x.png>"


def page_from(log, places=(), folder=None):
    flight = read_flight(log)
    album = Album([folder] if folder else [])
    limits = thresholds_of(value(flight.start, "decided", "rule", "sure"))
    return page_of(flight, list(places), album, album, "", limits)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A page of a flight over a ground of pictures."""
    folder = tmp_path_factory.mktemp("moved")
    (folder / "ref").mkdir()
    places = places_in(folder / "ref")
    log = write_log(folder / "log", *flown_over(places, COUNT))
    (folder / "page.html").write_text(page_from(log, places, folder / "ref"), "utf-8", "backslashreplace")
    return folder / "page.html"


@pytest.fixture
def page(browser, made):
    """The page on a phone, which must ask for nothing and complain of nothing."""
    with Opened(browser, made) as there:
        yield there


def known(path):
    return json.loads(re.search(r'id="steps">(.*?)</script>', path.read_text("utf-8"))[1])


def spots(page):
    return page.eval_on_selector_all(".spot", "all => all.map(each => each.getAttribute('class'))")


def test_the_slider_moves_texts_pictures_and_marks_by_keyboard(page, made):
    steps = known(made)["steps"]
    page.focus("#step")
    seen = set()
    for at in range(3):
        assert page.inner_text(".now h3") == steps[at]["title"]
        assert page.inner_text("#which") == f"{at + 1} of {COUNT}"
        pictures = page.eval_on_selector_all(".now img", "all => all.map(each => [each.alt, each.naturalWidth])")
        assert [alt for alt, _ in pictures] == [f"seen: 0{at}.png", f"place found: 0{at}.png"]
        assert all(width > 100 for _, width in pictures)
        accepted = "accepted" in steps[at]["at"]
        assert ("spot accepted" in spots(page)) == accepted
        assert page.locator(".claimed").count() == accepted
        seen.add(page.get_attribute(".spot.found", "d") + page.get_attribute(".square", "d"))
        page.keyboard.press("ArrowRight")
    assert len(seen) == 3, "the marks move"
    assert "missed" in steps[2]["at"], "a refused query is shown where GPS says it was"


def test_only_chosen_reasons_stay_on_ground_lanes_and_slider(page):
    page.click("summary:has-text('Show only some')")
    label = page.locator("label:has([data-group])", has_text="score … is below …")
    count = int(label.locator("b").inner_text())
    assert 0 < count < COUNT
    label.locator("input").check()
    assert page.inner_text("#which").endswith(f"of {count}")
    marks = "all => all.map(each => (each.getAttribute('d').match(/M/g) || []).length)"
    lanes = dict(
        zip(["accepted", "refused"], page.eval_on_selector_all(".mark:is(.accepted,.refused)", marks), strict=True)
    )
    assert lanes == {"accepted": 0, "refused": count}
    assert page.eval_on_selector_all(".dots.layer-accepted", marks) == [0]
    label.locator("input").uncheck()
    assert page.inner_text("#which").endswith(f"of {COUNT}")


@pytest.mark.parametrize("precision", [0.9, 0.99, 0.999, 0.99999])
def test_the_precision_slider_counts_what_the_judge_would_accept(page, made, precision):
    data = known(made)
    judged = [step["judged"] for step in data["steps"] if step["judged"]]
    needed = type(SURE)(SURE.models, precision).needed("down")
    added = sum(not each["accepted"] and each["sure"] >= needed for each in judged)
    lost = sum(each["accepted"] and each["sure"] < needed for each in judged)
    assert (added, lost) == (0, 0) if precision == 0.999 else added + lost > 0
    page.eval_on_selector(
        "#precision", f"each => {{each.value = {data['precisions'].index(precision)}; each.oninput()}}"
    )
    assert page.inner_text("#would").startswith(f"{added} more accepted, {lost} fewer")
    assert page.locator(".would.added").count() == (added > 0)
    assert page.locator("#others button").count() == min(added, 20) + min(lost, 20)
    if added:
        assert "3.3 m from GPS" in page.inner_text("#others li")
        page.click("#others button >> nth=0")
        assert page.inner_text(".now h3").endswith("refused")


def test_no_name_of_a_log_becomes_code(browser, tmp_path):
    log = write_log(tmp_path / "log", ("query", query(NASTY, reason=NASTY, reference_image=NASTY)))
    (tmp_path / "page.html").write_text(page_from(log), "utf-8", "backslashreplace")
    with Opened(browser, tmp_path / "page.html") as page:
        assert NASTY in page.inner_text(".now")
        assert page.locator("script").count() == 2


def test_a_damaged_log_still_has_its_steps(browser, tmp_path):
    """Models of another version, figures that are none, and no position at all."""
    rule = {"sure": {"precision": 0.999, "models": {"down": {"scale": "gone"}}}}
    broken = query("a", confidence="high", evidence=[], position={"lat_deg": 1e99}, located=None, fix=7, vehicle="?")
    lines = [("start", {"decided": {"rule": rule}}), ("query", broken), ("query", {"query": None, "place": 1e14})]
    (tmp_path / "page.html").write_text(page_from(write_log(tmp_path / "log", *lines)), "utf-8")
    with Opened(browser, tmp_path / "page.html") as page:
        assert page.inner_text("#which") == "1 of 2"
        assert page.locator("#precision").count() == 0
        assert page.locator(".view").count() == 0
