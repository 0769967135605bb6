"""Data sets of every layout that is known, and what is right in them."""

import csv

import cv2
import pytest
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import moved
from edgevpr.lab.evaluate.layouts import Nearness, open_folder

RULE = Nearness()


def pictures(folder, names):
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        cv2.imwrite(str(folder / name), textured(number, 32, 40))


def positions(folder, rows):
    with open(folder / "positions.csv", "w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "lat", "lon", "yaw_deg", "height_m"))
        table.writerows(rows)


def right_of(dataset):
    return {query.path.name: (set(query.right), set(query.ignored)) for query in dataset.queries}


@pytest.mark.parametrize("inside", ["", "images/test"])
def test_file_names_with_utm(tmp_path, inside):
    pictures(tmp_path / inside / "database", ["@0500000.00@4100000.00@10@S@.jpg", "@0500020@4100000@.jpg"])
    pictures(tmp_path / inside / "queries", ["@500005@4100000@q.jpg", "@510000@4100000@far.jpg"])
    assert right_of(open_folder(tmp_path, RULE)) == {
        "@500005@4100000@q.jpg": ({"@0500000.00@4100000.00@10@S@.jpg", "@0500020@4100000@.jpg"}, set())
    }
    (tmp_path / inside / "queries" / "@500005@4100000@q.jpg").rename(tmp_path / inside / "queries" / "@5@q.jpg")
    with pytest.raises(UsageError, match="EASTING"):
        open_folder(tmp_path, RULE)


def test_positions_by_distance_and_heading(tmp_path):
    pictures(tmp_path / "query", ["q.jpg", "nowhere.jpg"])
    pictures(tmp_path / "ref", ["near.jpg", "turned.jpg", "beside.jpg", "far.jpg"])
    here = 47.0, 8.0
    positions(tmp_path / "query", [("q.jpg", *here, 10, 50)])
    rows = {"near.jpg": (3, 0, 20), "turned.jpg": (0, 5, 190), "beside.jpg": (20, 0, 350), "far.jpg": (60, 0, 10)}
    positions(tmp_path / "ref", [(name, *moved(*here, *at[:2]), at[2], 50) for name, at in rows.items()])

    def right(**rule):
        found = right_of(open_folder(tmp_path, Nearness(**rule)))
        assert "nowhere.jpg" not in found
        return found["q.jpg"][0]

    assert right() == {"near.jpg", "turned.jpg", "beside.jpg"}
    assert right(within_m=4) == {"near.jpg"}
    assert right(within_deg=30) == {"near.jpg", "beside.jpg"}
    assert right(within_m=100) == {*rows}
    with pytest.raises(UsageError, match="--within-m"):
        right(within_m=0.1)


def test_what_is_no_data_set_is_told_what_is_one(tmp_path, capsys):
    with pytest.raises(UsageError, match=r"ground_truth\.csv"):
        open_folder(tmp_path, RULE)
    assert main(["eval", "--data", str(tmp_path / "no")]) == 2
    assert str(tmp_path / "no") in capsys.readouterr().err
    pictures(tmp_path / "query", ["0.jpg"])
    pictures(tmp_path / "ref", ["0.jpg"])
    assert main(["eval", "--data", str(tmp_path)]) == 2
    assert "positions.csv" in capsys.readouterr().err


def test_a_folder_is_measured(tmp_path, capsys):
    names = [f"{number}.jpg" for number in range(4)]
    for each in ("query", "ref"):
        pictures(tmp_path / each, names)
        positions(tmp_path / each, [(name, *moved(47.0, 8.0, 100 * at, 0), 0, 50) for at, name in enumerate(names)])
    assert main(["eval", "--data", str(tmp_path), "--techniques", "hog", "--param", "hog.w1=64"]) == 0
    assert "4 references" in capsys.readouterr().out
