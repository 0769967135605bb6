"""Data sets of every layout that is known, and what is right in them."""

import csv
import pickle
import shutil

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import moved
from edgevpr.lab.evaluate.evaluate import quietly
from edgevpr.lab.evaluate.layouts import Nearness, open_folder
from edgevpr.lab.evaluate.plan import SetPlan

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


def test_vpr_bench_has_numbers(tmp_path):
    pictures(tmp_path / "query", ["0.jpg", "1.jpg", "10.jpg"])
    pictures(tmp_path / "ref", ["2.jpg", "9.jpg", "11.jpg"])
    truth = np.empty((2, 2), object)
    truth[0], truth[1] = (0, [0, 1]), (2, [2])
    np.save(tmp_path / "ground_truth_new.npy", truth, allow_pickle=True)
    dataset = open_folder(tmp_path, RULE)
    assert right_of(dataset) == {"0.jpg": ({"2.jpg", "9.jpg"}, set()), "10.jpg": ({"11.jpg"}, set())}
    truth[0] = (0, [-1])
    np.save(tmp_path / "ground_truth_new.npy", truth, allow_pickle=True)
    assert list(right_of(open_folder(tmp_path, RULE))) == ["10.jpg"], "a query without a right reference is not scored"
    truth[1] = (2, [3])
    np.save(tmp_path / "ground_truth_new.npy", truth, allow_pickle=True)
    with pytest.raises(UsageError, match="numbers more than 3 queries"):
        open_folder(tmp_path, RULE)


def test_a_file_of_numbers_that_would_run_a_program_is_refused(tmp_path):
    pictures(tmp_path / "query", ["0.jpg"])
    pictures(tmp_path / "ref", ["0.jpg"])

    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    np.save(tmp_path / "ground_truth_new.npy", np.array([[0, Evil()]], object), allow_pickle=True)
    with pytest.raises(UsageError, match="VPR-Bench"):
        open_folder(tmp_path, RULE)
    assert not (tmp_path / "ran").exists()
    np.save(tmp_path / "ground_truth_new.npy", np.array([[0, [0]]], object), allow_pickle=True)
    whole = (tmp_path / "ground_truth_new.npy").read_bytes()
    head, end = whole[: whole.index(b"\n") + 1], whole.index(b"]\x94(")
    # An array of objects that gives their addresses in memory: NumPy itself would go there.
    addresses = whole[:end].replace(b"K?t", b"K\x00t") + b"C\x10" + 16 * b"A" + b"\x94t\x94b."
    for content in (b"", b"rubbish", head + pickle.dumps([1]), head + pickle.dumps(None), whole[:-9], addresses):
        (tmp_path / "ground_truth_new.npy").write_bytes(content)
        with pytest.raises(UsageError, match="VPR-Bench"):
            open_folder(tmp_path, RULE)


def test_vpr_tutorial_has_matrices_and_what_is_soft_does_not_count(tmp_path):
    pictures(tmp_path / "day", ["a.jpg", "b.jpg", "c.jpg"])
    pictures(tmp_path / "night", ["x.jpg", "y.jpg"])
    hard = np.array([[1, 0], [0, 1], [0, 0]])
    soft = np.array([[1, 0], [1, 1], [0, 1]])
    np.savez(tmp_path / "GT.npz", GThard=hard, GTsoft=soft)
    assert right_of(open_folder(tmp_path, RULE)) == {"x.jpg": ({"a.jpg"}, {"b.jpg"}), "y.jpg": ({"b.jpg"}, {"c.jpg"})}
    pictures(tmp_path / "snow", ["s.jpg"])
    with pytest.raises(UsageError, match="has not two folders"):
        open_folder(tmp_path, RULE)
    chosen = {"query": str(tmp_path / "night"), "ref": str(tmp_path / "day"), "ground_truth": str(tmp_path / "GT.npz")}
    assert set(right_of(SetPlan(**chosen).open(tmp_path, quietly))) == {"x.jpg", "y.jpg"}
    shutil.rmtree(tmp_path / "snow")
    np.savez(tmp_path / "GT.npz", GThard=hard.T, GTsoft=soft.T)
    with pytest.raises(UsageError, match="first folder by name"):
        open_folder(tmp_path, RULE)


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
