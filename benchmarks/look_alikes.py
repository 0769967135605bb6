"""Count matches among places that look alike to a forward camera: `python benchmarks/look_alikes.py [--sets A,B]`.

Each map is calibrated as by `map build`. Every query is matched twice: in the map, and in the map without its place and
the places that show the same ground, where each accepted match is wrong (*left_out*). *unproven*: right matches with at
most 8 agreeing landmarks, which would be lost if every match needed landmarks.
"""

import argparse

import base
import numpy as np
import walks
from base import DATA

from edgevpr.places.ranking import outside_neighbourhood
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.evidence import CHANCE_INLIERS, count_neighbours

SETS = ("thumbs_essex", "corridor", "grief_stromovka_seasons")
_NEIGHBOURS_LEFT_OUT = 8  # places along the route, on both sides
_COLUMNS = {name: f"{{{name}}}" for name in ("set", "queries", "right", "unproven", "wrong", "left_out")}


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
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", default=",".join(SETS), help="sets to match, comma-separated")
    print(base.format_table([measure_set(name) for name in parser.parse_args().sets.split(",")], _COLUMNS))


if __name__ == "__main__":
    base.run(main)
