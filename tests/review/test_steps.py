"""The page as its reader moves it, in a real browser: slider, ground, filter."""

import pytest
from browser import open_page, read_page_data
from ground import make_flight_lines, write_places
from logs import query, write_log

from edgevpr.review.album import make_album
from edgevpr.review.logged import read_flight
from edgevpr.review.page import make_flight_page

pytestmark = [pytest.mark.process, pytest.mark.slow]

COUNT = 30


def make_page(log, places=(), folder=None):
    album = make_album([folder] if folder else [])
    return make_flight_page(read_flight(log), list(places), album, album)


@pytest.fixture(scope="module")
def page_path(tmp_path_factory):
    """A page of a flight over a ground of pictures."""
    folder = tmp_path_factory.mktemp("moved")
    (folder / "ref").mkdir()
    places = write_places(folder / "ref")
    log = write_log(folder / "log", *make_flight_lines(places, COUNT))
    (folder / "page.html").write_text(make_page(log, places, folder / "ref"), "utf-8", "backslashreplace")
    return folder / "page.html"


@pytest.fixture
def page(browser, page_path):
    """The page on a phone, which must ask for nothing and complain of nothing."""
    with open_page(browser, page_path) as there:
        yield there


def test_slider_moves_texts_pictures_and_marks_by_keyboard(page, page_path):
    steps = read_page_data(page_path.read_text("utf-8"))["steps"]
    page.focus("#step")
    seen = set()
    for at in range(3):
        assert page.inner_text(".now h3") == steps[at]["title"]
        assert page.inner_text("#which") == f"{at + 1} of {COUNT}"
        pictures = page.eval_on_selector_all(".now img", "all => all.map(each => [each.alt, each.naturalWidth])")
        assert [alt.partition(": ")[2] for alt, _ in pictures] == [f"0{at}.png"] * 2
        assert all(width > 100 for _, width in pictures)
        accepted = "accepted" in steps[at]["points"]
        assert page.locator(".spot.accepted").count() == page.locator(".claimed").count() == accepted
        seen.add(page.get_attribute(".spot.found", "d") + page.get_attribute(".square", "transform"))
        page.keyboard.press("ArrowRight")
    assert len(seen) == 3, "the marks move"
    assert "refused_at" in steps[2]["points"], "a refused query is shown where GPS says it was"
    assert page.locator("image.layer-ground").count() == 12, "the map's own pictures"
    assert page.inner_text(".ruler") == "20 m"


def test_damaged_log_still_has_its_steps(browser, tmp_path):
    """Figures that are none, and no position at all."""
    broken = query("a", confidence="high", evidence=[], position={"lat_deg": 1e99}, located=None, fix=7, vehicle="?")
    log = write_log(tmp_path / "log", ("query", broken), ("query", {"query": None, "place": 1e14}))
    (tmp_path / "page.html").write_text(make_page(log), "utf-8")
    with open_page(browser, tmp_path / "page.html") as page:
        assert page.inner_text("#which") == "1 of 2"
        assert page.locator(".view").count() == 0
