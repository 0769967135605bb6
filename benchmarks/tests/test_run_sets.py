"""Tests of `make results` on a folder with small sets."""

import cv2
import pytest
import run_sets
import sets_page
from pictures import draw_texture

from edgevpr.core.geodesy import distance_m
from edgevpr.frames.positions import read_positions


def measure(data, out, *arguments):
    run_sets.main(["--data", str(data), "--out", str(out), *arguments])


def make_set(folder, places=4):
    truth = ["query_file,ref_files"]
    for split in ("ref", "query"):
        (folder / split).mkdir(parents=True)
        for place in range(places):
            cv2.imwrite(str(folder / split / f"{split}{place}.png"), draw_texture(place))
    truth += [f"query{place}.png,ref{place}.png" for place in range(places)]
    (folder / "ground_truth.csv").write_text("\n".join(truth))


def test_measure_writes_one_file_per_set_and_its_summary_lines(tmp_path):
    make_set(tmp_path / "data" / "meadow")
    make_set(tmp_path / "data" / "grief_stromovka_monthly", places=1)  # a set that is left out
    for variants in ("hog;cohog", "seqslam"):  # the second run adds to the file of the first
        measure(tmp_path / "data", tmp_path / "out", "--variants", variants)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["curves.png", "meadow.json", "sets.md"]

    (content,) = sets_page.read_sets(tmp_path / "out")
    assert content["use"] == "report"
    assert content["machine"]["cores"] >= 1
    assert list(content["techniques"]) == ["cohog", "hog", "seqslam"]
    assert [content["techniques"][name]["recall_at_1"] for name in ("hog", "cohog")] == [1, 1]
    assert all(row["commit"] for row in content["techniques"].values())

    page = (tmp_path / "out" / "sets.md").read_text()
    assert "| technique | RAM B/place | meadow (report, 4) |" in page
    assert "| cohog | 170 | 1.00 |" in page
    assert f"* grief_stromovka_monthly: {run_sets.FIVE_PLACES}" in page


def test_measure_places_site_sets_and_measures_known_headings(tmp_path):
    make_set(tmp_path / "data" / "meadow")
    make_set(tmp_path / "data" / "sat_town")
    rows = [f"{side}{n}.png,{'ab'[n // 2]},1,{240 * n},90,0" for side in ("query", "ref") for n in range(4)]
    (tmp_path / "data" / "sat_town" / "sites.csv").write_text("\n".join(["file,site,time,x_px,y_px,yaw_deg", *rows]))
    measure(tmp_path / "data", tmp_path / "out", "--variants", "cohog, known")
    assert not (tmp_path / "out" / "meadow.json").exists(), "the set has no headings"
    (content,) = sets_page.read_sets(tmp_path / "out")
    row = content["techniques"]["cohog, known"]
    assert (row["known"], row["parameters"]["camera"]) == ("heading,height", "nadir")

    placed = run_sets.place_sites(tmp_path / "data" / "sat_town", tmp_path)
    tags = [read_positions(placed / "positions.csv")[f"ref{n}.png"] for n in range(4)]
    positions = [(tag.position.lat_deg, tag.position.lon_deg) for tag in tags]
    assert distance_m(*positions[0], *positions[1]) == pytest.approx(120, abs=0.1)
    assert distance_m(*positions[0], *positions[2]) > 10_000
    assert tags[0].heading_deg == 0
