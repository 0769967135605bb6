"""The pictures of a page: found by their names, laid on the ground, and small enough."""

from dataclasses import replace

import numpy as np
import pytest
from ground import write_places
from PIL import Image
from rasters import HOME, write_textured_raster

from edgevpr.core.types import Place, Pose
from edgevpr.frames.level import Lens
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.review.album import embed_pictures, make_album, make_map_album

LENS = Lens(60.0)
POSE = Pose(up_deg=0.0, footprint_m=60.0, covariance_m2=(1.0, 0.0, 1.0))


def test_align_picture_returns_the_image_in_the_orientation_of_the_pose(tmp_path):
    places = write_places(tmp_path)
    tags = {place.source_image: GeoTag(position=place.position, heading_deg=place.pose.up_deg) for place in places}
    write_positions(tmp_path / "positions.csv", tags)
    album, turned = make_album([tmp_path]), places[4]
    north_up = replace(turned, pose=replace(turned.pose, up_deg=0.0))
    assert album.align_picture(turned, None).mask is None
    assert album.align_picture(turned, LENS).mask is None, "the map was made without the lens"
    assert album.align_picture(north_up, LENS).mask is not None, "it was made with it"
    assert album.align_picture(north_up, None) is None, "its heading contradicts the map"
    assert album.align_picture(replace(turned, source_image="gone.png"), LENS) is None


@pytest.mark.parametrize("upright", [True, False])
def test_make_map_album_turns_images_only_if_they_are_to_be_upright(tmp_path, upright):
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera's right side is up
    Image.fromarray(np.full((60, 80, 3), 128, np.uint8)).save(tmp_path / "photo.jpg", exif=exif)
    places = [Place(place_id=1, source_image="photo.jpg", position=HOME, pose=POSE)]
    album = make_map_album([tmp_path], places, upright=upright)
    assert album.find_image("photo.jpg").shape[:2] == ((80, 60) if upright else (60, 80))


def test_make_map_album_cuts_the_pictures_of_an_orthophoto_again(tmp_path):
    pytest.importorskip("rasterio")
    pose = replace(POSE, is_surveyed=True)
    places = [Place(place_id=1, source_image="town.tif_r000_c000", position=HOME, pose=pose)]
    album = make_map_album([write_textured_raster(tmp_path / "town.tif")], places, upright=False)
    assert album.find_image("town.tif_r000_c000").std() > 10
    assert album.find_image("town.tif_r000_c001") is None
    assert album.align_picture(places[0], None).image.std() > 10
    assert make_map_album([], places, upright=False).find_image("town.tif_r000_c000") is None


def test_embed_pictures_shrinks_images_and_then_drops_some(tmp_path):
    keys = [[("seen", place.source_image)] for place in write_places(tmp_path)]
    albums = {"seen": make_album([tmp_path])}
    sizes = []
    for room_bytes in (1e6, 3e4, 6e3):
        found, left_out = embed_pictures(keys, albums, room_bytes)
        assert sum(map(len, found.values())) <= room_bytes
        assert bool(left_out) == (len(found) < len(keys))
        sizes.append(len(found))
    assert sizes[0] == sizes[1] == len(keys) > sizes[2] > 0
