"""The page of a map."""

from dataclasses import replace
from shutil import copyfile

import pytest
from browser import open_page, read_page_data
from commands import expect_refusal
from ground import STEP_M, to_lat_lon, write_places

from edgevpr.cli.main import main
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.places.mapfile import PlaceMap
from edgevpr.review.mappage import find_gaps, measure_inconsistent_tags

TWIN = "twin.png"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with valley.gpkg and its pictures `ref`; one of them is that of a place 300 m away again."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "ref").mkdir()
    places = write_places(folder / "ref")
    copyfile(folder / "ref" / places[5].source_image, folder / "ref" / TWIN)
    far = replace(places[5], source_image=TWIN, position=Position(*to_lat_lon(300.0, 0.0)), pose=None)
    tags = {
        each.source_image: GeoTag(position=each.position, heading_deg=each.pose and each.pose.up_deg)
        for each in [*places, far]
    }
    write_positions(folder / "ref" / "positions.csv", tags)
    argv = ["map", "build", folder / "valley.gpkg", "--images", folder / "ref", "--camera", "nadir", "--no-refine"]
    assert main([*map(str, argv), "--no-calibrate", "--technique", "cohog"]) == 0
    with PlaceMap.open_for_writing(folder / "valley.gpkg") as place_map, place_map.transaction():
        for place in places:
            recorded = Position(*to_lat_lon(9.0, 90.0)) if place.place_id == 3 else place.position
            place_map.move_place(place.place_id, place.position, replace(place.pose, recorded=recorded))
    return folder


@pytest.mark.process
@pytest.mark.slow
def test_map_page_shows_places_and_their_problems(browser, folder):
    out = folder / "map.html"
    argv = ["map", "info", folder / "valley.gpkg", "--page", out, "--map-images", folder / "ref"]
    assert main(list(map(str, argv))) == 0
    data = read_page_data(out.read_text("utf-8"))
    alike = {step["title"]: step["texts"][-1] for step in data["steps"] if "looks like" in step["texts"][-1]}
    assert "place 13: " in alike["Place 6: 05.png"]
    assert "place 6: " in alike[f"Place 13: {TWIN}"]
    assert all("place 13: " in said for title, said in alike.items() if TWIN not in title), "they overlap with its twin"
    with open_page(browser, out) as page:
        assert page.locator("image").count() == 12
        page.focus("#step")
        for _ in range(5):
            page.keyboard.press("ArrowRight")
        alts = page.eval_on_selector_all(".now img", "all => all.map(each => each.alt)")
        assert alts[0] == "place 6: 05.png"
        assert [alt.endswith(f": place 13: {TWIN}") for alt in alts[1:]] == [True]
        assert page.locator(".spot.alike").count() == 1
        page.locator("label:has([data-group])", has_text="inconsistent GPS tag").locator("input").check()
        assert page.inner_text(".now h3") == "Place 3: 02.png"
        assert page.locator(".line.tag").count() == 1
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.slow
def test_map_page_is_never_written_over_the_map(folder, capsys):
    before = (folder / "valley.gpkg").read_bytes()
    path = folder / "valley.gpkg"
    assert "another output" in expect_refusal(capsys, "map", "info", path, "--page", path)
    assert (folder / "valley.gpkg").read_bytes() == before


def test_find_gaps_finds_ground_missing_between_images(tmp_path):
    place, *_ = write_places(tmp_path)
    pose, steps_m = replace(place.pose, up_deg=0.0), [number * STEP_M for number in range(5)]
    positions = [Position(*to_lat_lon(east_m, north_m)) for east_m in steps_m for north_m in steps_m]
    places = [replace(place, pose=pose, position=position) for position in positions]
    gaps, covered_m2, gaps_m2 = find_gaps(places)
    assert (gaps, gaps_m2) == ([], 0.0)
    assert covered_m2 == pytest.approx((4 * STEP_M + 30) ** 2, rel=0.1)
    gaps, _, gaps_m2 = find_gaps([place for at, place in enumerate(places) if at not in (7, 11, 12, 13, 17)])
    assert len(gaps) == 1
    assert 500 < gaps_m2 < 3000
    assert find_gaps([replace(place, pose=None) for place in places]) == ([], 0.0, 0.0)


def test_measure_inconsistent_tags_finds_tags_far_from_their_images(tmp_path):
    places = [
        replace(place, pose=replace(place.pose, recorded=Position(*to_lat_lon(0.1 * at, 400.0 if at == 4 else 0.0))))
        for at, place in enumerate(write_places(tmp_path))
    ]
    places = [replace(place, position=Position(*to_lat_lon(0.0, 0.0))) for place in places]
    assert list(measure_inconsistent_tags(places)) == [5]
