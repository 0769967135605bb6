"""Photographs for `bench_fleet.py`: real ones of aerial sets whose positions are known, 320 pixels wide, each as it is,
and again and again, turned, brighter or darker, blurred and with noise, in copies of its site that lie beside it; every
fourth is generated."""

from collections.abc import Iterator
from pathlib import Path

import base
import cv2
import numpy as np

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.core.types import Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import GeoTag, read_positions, write_positions

SETS = ("aerial_brighton", "aerial_caliterra", "aerial_garfield28", "aerial_swindale")
SIDE_PX, GENERATED, BESIDE_M = 320, 0.25, 60.0
GENERATED_AT, GENERATED_STEP_M = Position(47.0, 8.0), 25.0
_SEED = 8


def changed(image: np.ndarray, number: int) -> np.ndarray:
    """Change a picture as by another flight; number 0 leaves it as it is."""
    if not number:
        return image
    rng = np.random.default_rng((_SEED, number))
    high, wide = image.shape[:2]
    turn = cv2.getRotationMatrix2D((wide / 2, high / 2), rng.uniform(0, 360), 1.3)
    image = cv2.warpAffine(image, turn, (wide, high), borderMode=cv2.BORDER_REFLECT)
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.5))
    light = rng.uniform(0.6, 1.5) * image + rng.normal(0, rng.uniform(1, 8), image.shape)
    return np.clip(light, 0, 255).astype(np.uint8)


def generated(number: int, side_px: int = SIDE_PX) -> np.ndarray:
    """Draw ground that exists nowhere: noise at all scales."""
    rng, ground = np.random.default_rng((_SEED, 1, number)), np.zeros((side_px * 3 // 4, side_px, 3))
    for cells in (4, 12, 36, 108):
        noise = rng.normal(0, 60, (cells * 3 // 4, cells, 3))
        ground += cv2.resize(noise, (side_px, side_px * 3 // 4), interpolation=cv2.INTER_CUBIC) / np.sqrt(cells / 4)
    return np.clip(128 + ground, 0, 255).astype(np.uint8)


def real(count: int) -> Iterator[tuple[str, np.ndarray, GeoTag]]:
    """Yield `count` names, pictures and tags of real photographs: each site, then copies of it beside it."""
    sites = []
    for folder in base.find_sets(names=SETS):
        tags = {name: tag for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
        paths = {path.name: path for part in ("ref", "query") for path in (folder / part).iterdir()}
        sites.append((folder.name, {name: (paths[name], tag) for name, tag in tags.items() if name in paths}))
    images = {path: small(read_image(path)) for _, found in sites for path, _ in found.values()}
    across = int(np.ceil(np.sqrt(count / len(images))))
    copy = written = 0
    while written < count:
        for site, found in sites:
            points = np.array([(tag.position.lat_deg, tag.position.lon_deg) for _, tag in found.values()])
            (south, west), (north, east) = points.min(axis=0), points.max(axis=0)
            size_m = distance_m(south, west, south, east) + BESIDE_M, distance_m(south, west, north, west) + BESIDE_M
            for name, (path, tag) in list(found.items())[: count - written]:
                by_m = (copy % across * size_m[0], copy // across * size_m[1])
                position = Position(*moved(tag.position.lat_deg, tag.position.lon_deg, *map(float, by_m)))
                image = changed(images[path], copy * len(images) + written if copy else 0)
                yield f"{site}/{copy:03d}_{Path(name).stem}.jpg", image, GeoTag(position=position)
                written += 1
        copy += 1


def small(image: np.ndarray) -> np.ndarray:
    high, wide = image.shape[:2]
    return cv2.resize(image, (SIDE_PX, round(SIDE_PX * high / wide)), interpolation=cv2.INTER_AREA)


def write_pictures(folder: Path, count: int) -> None:
    """Write the photographs, a folder a site with its table."""
    made, tables = int(GENERATED * count), dict[str, dict[str, GeoTag]]()
    across = int(np.ceil(np.sqrt(made)))

    def drawn() -> Iterator[tuple[str, np.ndarray, GeoTag]]:
        for number in range(made):
            offset_m = [GENERATED_STEP_M * each for each in divmod(number, across)]
            at = Position(*moved(GENERATED_AT.lat_deg, GENERATED_AT.lon_deg, *offset_m))
            yield f"generated/{number:05d}.jpg", generated(number), GeoTag(position=at)

    for pictures in (real(count - made), drawn()):
        for name, image, tag in pictures:
            site, _, file = name.partition("/")
            (folder / site).mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
            tables.setdefault(site, {})[file] = tag
    for site, tags in tables.items():
        write_positions(folder / site / "positions.csv", tags)
