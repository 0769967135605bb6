"""Count matches among places that look alike to a forward camera: `python benchmarks/look_alikes.py [--sets A,B]`.

Each map is calibrated as by `map build`. Every query is matched twice: in the map, and in the map without its place and
the places that show the same ground, where each accepted match is wrong (*left_out*). *unproven*: right matches with at
most 8 agreeing landmarks, which would be lost if every match needed landmarks. *repeats*: matches accepted in another
map, of which each place shows only the middle of its picture, around which is the picture of a place half the map away,
as if the same door, furrow or shelf were elsewhere; all of them are wrong.
"""

import argparse
import tempfile
from pathlib import Path

import base
import cv2
import numpy as np
import walks
from base import DATA

from edgevpr.core.arrays import Image
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.places.ranking import outside_neighbourhood
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.evidence import CHANCE_INLIERS, count_neighbours

SETS = ("thumbs_essex", "corridor", "grief_stromovka_seasons", "grief_michigan_monthly", "grief_stromovka_monthly")
_NEIGHBOURS_LEFT_OUT = 8  # places along the route, on both sides
_REPEATED = 0.7  # of the width and height of a picture
_COLUMNS = {name: f"{{{name}}}" for name in ("set", "queries", "right", "unproven", "wrong", "left_out", "repeats")}


def measure_set(name: str) -> base.Row:
    """Match all queries of one set, and return the counts."""
    folder = DATA / name
    dataset = walks.load_matched_set(folder)
    row: base.Row = {"set": name, "queries": len(dataset.queries), "right": 0, "unproven": 0, "wrong": 0, "left_out": 0}
    with walks.make_map(folder, images=folder / "ref") as (place_map, index, technique):
        calibration = read_calibration_for(place_map)
        neighbours = _NEIGHBOURS_LEFT_OUT if count_neighbours(calibration.look_alikes if calibration else None) else 0
        walk, slots = walks.make_walk(place_map, index, technique), np.arange(len(index))
        with_landmarks = walks.make_walk(place_map, index, technique, all_evidence=True)
        for query in dataset.queries:
            event = walk.step(walks.make_frame(query.path))
            if event.accepted:
                image = event.best.place.source_image
                is_right = image in query.correct or image in query.ignored
                row["right" if is_right else "wrong"] += 1
                landmarks = with_landmarks.step(walks.make_frame(query.path)).evidence.landmarks
                row["unproven"] += is_right and landmarks <= np.log1p(CHANCE_INLIERS)
            right_slots = [slot for slot in slots if dataset.references[slot] in {*query.correct, *query.ignored}]
            masks = [outside_neighbourhood(index, slot, slots, 0.0, max_slots=neighbours) for slot in right_slots]
            remaining = index.select(np.all(masks, axis=0))
            without = walks.make_walk(place_map, remaining, technique, rule=walk.rule)
            row["left_out"] += without.step(walks.make_frame(query.path)).accepted
    return row | {"repeats": count_repeats(folder, dataset)}


def count_repeats(folder: Path, dataset: Dataset) -> int:
    """Match all queries of a set in a map of repeats, calibrated as by `map build`; return how many are accepted."""
    frames = list(walks.read_folder_frames(folder / "ref"))
    with tempfile.TemporaryDirectory() as temporary:
        images = Path(temporary) / "ref"
        images.mkdir()
        for frame, other in zip(frames, np.roll(np.arange(len(frames)), len(frames) // 2), strict=True):
            cv2.imwrite(str(images / f"{Path(frame.name).stem}.png"), draw_repeat(frame.image, frames[other].image))
        technique = walks.make_cohog(base.infer_camera(folder.name))
        with walks.make_map(images.parent, technique, images) as (place_map, index, _):
            walk = walks.make_walk(place_map, index, technique)
            return sum(walk.step(walks.make_frame(query.path)).accepted for query in dataset.queries)


def draw_repeat(picture: Image, surroundings: Image) -> Image:
    """Return the middle of a picture in other surroundings, with a soft edge."""
    height, width = picture.shape[:2]
    surroundings = cv2.resize(surroundings, (width, height), interpolation=cv2.INTER_AREA)
    top, left = round((1 - _REPEATED) / 2 * height), round((1 - _REPEATED) / 2 * width)
    share = np.zeros((height, width, *[1] * (picture.ndim - 2)), np.float32)
    share[top:-top, left:-left] = 1.0
    share = cv2.GaussianBlur(share, (0, 0), 0.02 * width).reshape(share.shape)
    return np.round(share * picture + (1 - share) * surroundings).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", default=",".join(SETS), help="sets to match, comma-separated")
    print(base.format_table([measure_set(name) for name in parser.parse_args().sets.split(",")], _COLUMNS))


if __name__ == "__main__":
    base.run(main)
