"""Data sets of every layout that is known, and what is wrong in others."""

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_position
from edgevpr.lab.evaluate.dataset import load_dataset, open_folder


@pytest.fixture
def folder(tmp_path):
    """Three queries, three references; no ground truth yet."""
    for split in ("query", "ref"):
        write_pictures(tmp_path / split, ["a.png", "b.png", "c.png"])
    return tmp_path


def load(folder, truth):
    if isinstance(truth, str):
        truth = truth.encode()
    (folder / "truth.csv").write_bytes(truth)
    return load_dataset(folder / "query", folder / "ref", folder / "truth.csv")


def test_load_dataset_reads_right_and_ignored_references_of_scored_queries(folder):
    dataset = load(
        folder,
        "query_file,overlap,ref_files,ref_files_loose,status\n"
        "b.png,0.8,a.png b.png,a.png b.png c.png,ok\n"
        "a.png,,c.png,,ok\n"
        "c.png,0.1,,a.png,loose_only\n",
    )
    assert dataset.references == ("a.png", "b.png", "c.png")
    assert dataset.queries[0].path == folder / "query" / "b.png"
    assert list_correct(dataset) == {"b.png": ({"a.png", "b.png"}, {"c.png"}), "a.png": ({"c.png"}, set())}
    assert dataset.unscored == 1


@pytest.mark.parametrize("row", ["b.png,,,ok", "b.png,,,NOVEL", "b.png,,, "])
def test_load_dataset_reads_a_query_off_the_map(folder, row):
    dataset = load(folder, f"query_file,ref_files,ref_files_loose,status\n{row}\na.png,a.png,,ok\n")
    assert list_correct(dataset) == {"b.png": (set(), set()), "a.png": ({"a.png"}, set())}
    assert dataset.unscored == 1


def test_load_dataset_counts_scored_queries_that_are_copies_of_references(folder):
    for number, name in enumerate(("a.png", "b.png", "c.png")):
        (folder / "ref" / name).write_bytes(b"same size %d" % number)
    (folder / "query" / "a.png").write_bytes(b"same size 2")
    (folder / "query" / "b.png").write_bytes(b"same size 7")
    (folder / "query" / "c.png").write_bytes(b"same size 1")
    assert load(folder, "query_file,ref_files\na.png,c.png\nb.png,b.png\n").copied == 1


def test_load_dataset_reads_a_spreadsheet_export_without_some_queries(folder):
    dataset = load(folder, b"\xef\xbb\xbfquery_file,ref_files\r\n b.png , b.png \r\n\r\n")
    assert [(query.path.name, query.correct) for query in dataset.queries] == [("b.png", {"b.png"})]


HEADER = "query_file,ref_files,status\n"


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("query_file,refs\na.png,a.png\n", ["truth.csv", "lacks the column `ref_files`"]),
        ("", ["truth.csv", "lacks the column `query_file`"]),
        (HEADER + "a.png,a.png,ok\nz.png,a.png,ok\n", ["truth.csv", "`z.png`", "correct its name"]),
        (HEADER + "a.png,a.png y.png,ok\n", ["truth.csv", "`y.png`", "correct its name"]),
        (HEADER + "a.png,a.png,novel\n", ["truth.csv, line 2", "`a.png`", "`novel` but has ref_files"]),
        (HEADER + "a.png,a.png,ok\na.png,b.png,ok\n", ["truth.csv, line 3", "`a.png`", "keep one"]),
        (HEADER + "a.png,a.png\n", ["truth.csv, line 2", "fields"]),
        (HEADER + "a.png,a.png,uncertain\n", ["truth.csv", "no query"]),
        (b"\xff\xd8\xff\xe0 a JPEG", ["truth.csv", "not a UTF-8 CSV file"]),
    ],
)
def test_load_dataset_names_line_and_value_of_a_wrong_file(folder, truth, said):
    with pytest.raises(UsageError) as error:
        load(folder, truth)
    for part in said:
        assert part in str(error.value)
    assert "\n" not in str(error.value)


def test_load_dataset_refuses_a_missing_file(folder):
    with pytest.raises(UsageError, match=r"nowhere\.csv"):
        load_dataset(folder / "query", folder / "ref", folder / "nowhere.csv")


def write_pictures(folder, names):
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((8, 8), np.uint8))


def list_correct(dataset):
    return {query.path.name: (set(query.correct), set(query.ignored)) for query in dataset.queries}


@pytest.mark.parametrize("inside", ["", "images/test"])
def test_open_folder_reads_utm_coordinates_from_names(tmp_path, inside):
    places = {"@0500000.00@4100000.00@10@S@.jpg", "@0500020@4100000@.jpg"}
    write_pictures(tmp_path / inside / "database", places)
    queries = tmp_path / inside / "queries"
    write_pictures(queries, ["@500005@4100000@q.jpg", "@510000@4100000@far.jpg"])
    assert list_correct(open_folder(tmp_path, 25)) == {
        "@500005@4100000@q.jpg": (places, set()),
        "@510000@4100000@far.jpg": (set(), set()),
    }
    (queries / "@500005@4100000@q.jpg").rename(queries / "@5@q.jpg")
    with pytest.raises(UsageError, match="EASTING"):
        open_folder(tmp_path, 25)


def test_open_folder_matches_positions_by_distance(tmp_path, caplog):
    here = 47.0, 8.0
    queries = {"q.jpg": (0, 0), "far.jpg": (600, 0)}
    places = {"near.jpg": (3, 0), "beside.jpg": (20, 0), "far.jpg": (60, 0)}
    for side, offsets in (("query", queries), ("ref", places)):
        write_pictures(tmp_path / side, [*offsets, "nowhere.jpg"])
        points = {name: offset_position(*here, *offset_m) for name, offset_m in offsets.items()}
        rows = [f"{name},{','.join(map(repr, point))}" for name, point in points.items()]
        (tmp_path / side / "positions.csv").write_text("\n".join(["file,lat,lon", *rows]))
    dataset, unplaced = open_folder(tmp_path, 25), {"nowhere.jpg"}
    assert list_correct(dataset) == {"q.jpg": ({"near.jpg", "beside.jpg"}, unplaced), "far.jpg": (set(), unplaced)}
    assert "1 of 4 references have no position" in caplog.text
    assert dataset.unscored == 1
    assert list_correct(open_folder(tmp_path, 4))["q.jpg"] == ({"near.jpg"}, unplaced)
    with pytest.raises(UsageError, match="--within-m"):
        open_folder(tmp_path, 0.1)
    (tmp_path / "ref" / "positions.csv").unlink()
    with pytest.raises(UsageError, match="No positions"):
        open_folder(tmp_path, 25)
