"""The ground of a page, laid of the map's own pictures; and small pictures within a budget."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ground import METRE_PX, ORIGIN, landscape, places_in, write_positions
from rasters import HOME, textured_raster

from edgevpr.core.types import Place, Pose
from edgevpr.frames.level import Lens
from edgevpr.review.album import album_of_map, make_album, small_pictures
from edgevpr.review.mosaic import lay_mosaic


def assert_is_the_ground(found):
    """Hold the picture of the ground against the landscape."""
    mosaic, lacking = found
    assert not lacking
    seen = cv2.imdecode(np.frombuffer(mosaic.webp, np.uint8), cv2.IMREAD_UNCHANGED)
    west, south, east, north = mosaic.edges_m
    assert seen.shape[0] / seen.shape[1] == pytest.approx((north - south) / (east - west), rel=0.01)
    scale = (east - west) / seen.shape[1] * METRE_PX
    way = np.array([[scale, 0, 280 + west * METRE_PX], [0, scale, 280 - north * METRE_PX]])
    ground = cv2.warpAffine(landscape(), way, seen.shape[1::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    shown = seen[..., 3] == 255
    assert 0.3 < shown.mean() < 0.9, "what no picture shows is transparent"
    assert abs(seen[..., :3].astype(int) - ground)[shown].mean() < 12
    assert shown[seen.shape[0] // 2, seen.shape[1] // 2]


def test_lay_mosaic_puts_pictures_where_their_poses_say(tmp_path):
    assert_is_the_ground(lay_mosaic(places_in(tmp_path), make_album([tmp_path]), None, ORIGIN))


def test_a_map_of_levelled_pictures_is_laid_with_its_lens(tmp_path):
    places = places_in(tmp_path)
    write_positions(tmp_path / "positions.csv", places)
    north_up = [replace(each, pose=replace(each.pose, up_deg=0.0)) for each in places]
    assert_is_the_ground(lay_mosaic(north_up, make_album([tmp_path]), Lens(60.0), ORIGIN))
    assert lay_mosaic(north_up, make_album([tmp_path]), None, ORIGIN)[0] is None
    assert_is_the_ground(lay_mosaic(places, make_album([tmp_path]), Lens(60.0), ORIGIN))  # it was made without the lens


@pytest.mark.parametrize(
    ("places", "folder", "said"),
    [
        (lambda places: places, False, "With --map-images"),
        (lambda places: [replace(each, source_image="gone.png") for each in places], True, "No picture of the map is"),
        (lambda places: [replace(each, pose=None) for each in places], True, "No place knows how its picture lies"),
        (
            lambda places: [
                replace(each, pose=replace(each.pose, up_deg=(each.pose.up_deg * 3) % 360)) for each in places
            ],
            True,
            "do not fit each other",
        ),
    ],
)
def test_where_there_can_be_no_picture_of_the_ground_it_is_said(tmp_path, places, folder, said):
    mosaic, lacking = lay_mosaic(places(places_in(tmp_path)), make_album([tmp_path] if folder else []), None, ORIGIN)
    assert mosaic is None
    assert said in lacking


def test_the_pictures_of_a_map_of_an_orthophoto_are_cut_from_it_again(tmp_path):
    pytest.importorskip("rasterio")
    pose = Pose(up_deg=0.0, footprint_m=60.0, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=True)
    places = [Place(place_id=1, source_image="town.tif_r000_c000", position=HOME, pose=pose)]
    album = album_of_map([textured_raster(tmp_path / "town.tif")], places)
    assert album.image("town.tif_r000_c000").std() > 10
    assert album.image("town.tif_r000_c001") is None
    assert lay_mosaic(places, album, None, (HOME.lat_deg, HOME.lon_deg))[0]
    assert album_of_map([], places).image("town.tif_r000_c000") is None


def test_pictures_get_smaller_and_then_fewer_until_they_fit(tmp_path):
    keys = [[("seen", place.source_image)] for place in places_in(tmp_path)]
    albums = {"seen": make_album([tmp_path])}
    sizes = []
    for room_bytes in (1e6, 3e4, 6e3):
        found, left_out = small_pictures(keys, albums, room_bytes)
        assert sum(map(len, found.values())) <= room_bytes
        assert bool(left_out) == (len(found) < len(keys))
        sizes.append(len(found))
    assert sizes[0] == sizes[1] == len(keys) > sizes[2] > 0
