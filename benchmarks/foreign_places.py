"""Make places that no query of the sites in `sites.py` shows, to fill a map up to ten thousand places.

Looking down: pictures of the sites themselves, mirrored and cropped to at least half of each side, then generated
landscapes. A mirrored picture shows ground that exists nowhere, with the same grass, roofs and light as the queries.
Looking ahead: pictures of other sets, whole, their left and their right 70 %, then all of these mirrored.
"""

import itertools
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import walks

from edgevpr.core.types import Frame
from edgevpr.frames.images import list_images, read_image
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, light_scene, photograph
from edgevpr.lab.simulate.generated import SCENE_DEPTH_M, SCENE_WIDTH_M
from edgevpr.lab.simulate.landscape import make_scene

# Prefixes of the names of places.
MIRRORED_PREFIX = "mirrored"
GENERATED_PREFIX = "generated"
OTHER_SET_PREFIX = "other set"
# None shows a site of a query. grief_stromovka_monthly would: it is the park of grief_stromovka_seasons.
OTHER_SETS = ("nordland_tiny/ref", "nordland_tiny/query", "train_ie_tower/images", "grief_michigan_monthly/query")
_CROPS_PER_IMAGE = 8
_MARGIN_M = 65.0  # of a scene, so that no picture shows what is beyond its edge
_PLACES_EAST = 22  # of a scene
_PLACES_NORTH = 12
_FIRST_SEED = 1000  # of the generated landscapes


def yield_foreign_places(camera: str, count: int, data: Path, sites: list[Path]) -> Iterator[Frame]:
    """Yield the frames of `count` places in the order of mapping, or of all that exist (looking ahead)."""
    frames = _yield_nadir_places(sites) if camera == "nadir" else _yield_forward_places(data)
    return itertools.islice(frames, count)


def _yield_nadir_places(sites: list[Path]) -> Iterator[Frame]:
    for site in sites:
        for part in ("ref", "query"):
            for path in list_images(site / part):
                mirrored = read_image(path)[:, ::-1]
                rng = np.random.default_rng(zlib.crc32(f"{site.name}/{path.name}".encode()))
                for number in range(_CROPS_PER_IMAGE):
                    name = f"{MIRRORED_PREFIX}/{site.name}/{path.name}/{number}"
                    crop = _crop_image(mirrored, *rng.uniform((0.5, 0, 0), (1, 1, 1)))
                    yield walks.make_frame(np.ascontiguousarray(crop), name)
    for seed in itertools.count(_FIRST_SEED):
        yield from _yield_landscape(seed)


def _crop_image(image: np.ndarray, share: float, down: float, right: float) -> np.ndarray:
    """Crop a picture to a `share` of its sides. `down`, `right` (0..1): where the crop is."""
    height, width = (round(share * side) for side in image.shape[:2])
    top, left = round(down * (image.shape[0] - height)), round(right * (image.shape[1] - width))
    return image[top : top + height, left : left + width]


def _yield_landscape(seed: int) -> Iterator[Frame]:
    """Yield the places of a generated landscape, in random light, from heights of 50 to 80 m."""
    rng = np.random.default_rng(seed)
    light = Light(
        sun_azimuth_deg=rng.uniform(0, 360),
        sun_elevation_deg=rng.uniform(25, 65),
        warmth=rng.uniform(0, 0.8),
        cloud_frac=rng.uniform(0, 0.4),
        exposure=rng.uniform(0.8, 1.2),
    )
    scene = make_scene(seed, SCENE_WIDTH_M, SCENE_DEPTH_M)
    ground = light_scene(scene, light, seed)
    for north_m in np.linspace(_MARGIN_M, SCENE_DEPTH_M - _MARGIN_M, _PLACES_NORTH):
        for east_m in np.linspace(_MARGIN_M, SCENE_WIDTH_M - _MARGIN_M, _PLACES_EAST):
            height_m, heading_deg = rng.uniform((50, 0), (80, 360))
            pose = CameraPose(east_m=east_m, north_m=north_m, height_m=height_m, heading_deg=heading_deg)
            image = photograph(ground, scene.metres_per_pixel, pose, Camera(), light, rng)
            yield walks.make_frame(image, f"{GENERATED_PREFIX}/{seed}/{north_m:.0f}/{east_m:.0f}")


def _yield_forward_places(data: Path) -> Iterator[Frame]:
    cuts = {"whole": (0.0, 1.0), "left": (0.0, 0.7), "right": (0.3, 1.0)}
    for is_mirrored in (False, True):
        for cut, (start, end) in cuts.items():
            for folder in OTHER_SETS:
                for path in list_images(data / folder):
                    image = read_image(path)
                    width = image.shape[1]
                    image = image[:, round(start * width) : round(end * width)][:, :: -1 if is_mirrored else 1]
                    change = f"{'mirrored ' if is_mirrored else ''}{cut}"
                    name = f"{OTHER_SET_PREFIX}/{change}/{folder}/{path.name}"
                    yield walks.make_frame(np.ascontiguousarray(image), name)
