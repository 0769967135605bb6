"""The points of a flight for other programs."""

import io
import json
from collections import Counter

from logs import query, write_log

from edgevpr.cli.main import main
from edgevpr.review.export import make_features, write_geojson
from edgevpr.review.logged import read_flight


def written(features):
    out = io.StringIO()
    write_geojson(features, out)
    return json.loads(out.getvalue())["features"]


def test_make_features_of_a_real_flight_has_all_kinds(flown):
    features = make_features(read_flight(flown / "flight.jsonl"))
    kinds = Counter(each["kind"] for each in features)
    assert (kinds["match"], kinds["autopilot"], kinds["gps"]) == (8, 10, 10)
    assert kinds["fix"] > 0
    assert [each["properties"]["kind"] for each in written(features)] == [each["kind"] for each in features]


def test_write_a_match_says_where_it_is_and_what_is_known_of_it(tmp_path):
    located = {"lat_deg": -33.5, "lon_deg": 151.25}
    flight = read_flight(write_log(tmp_path / "log", ("query", query("a", located=located))))
    match = written(make_features(flight))[0]
    assert match["geometry"] == {"type": "Point", "coordinates": [151.25, -33.5]}
    assert match["properties"].items() >= {"kind": "match", "query": "a", "place": 3, "accuracy_m": 2.0}.items()


def test_features_of_a_fix_between_matches_is_a_point_too(tmp_path):
    between = {"lat_deg": 50.0, "lon_deg": 8.0, "accuracy_m": 4.5}
    flight = read_flight(write_log(tmp_path / "log", ("query", query("a")), ("between", between), ("between", {})))
    (found,) = [each for each in make_features(flight) if each["kind"] == "between"]
    assert found.items() >= between.items()
    assert not flight.remarks


def test_export_writes_a_file_or_standard_output(tmp_path, capsys):
    at = {"lat_deg": 51.0, "lon_deg": 8.0}
    log = write_log(tmp_path / "log", ("query", query("a", located=at, position=None, fix=None)))
    out = tmp_path / "out.geojson"
    assert main(["export", str(log), "--geojson", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 1 points\n"
    assert main(["export", str(log), "--geojson", "-"]) == 0
    assert capsys.readouterr().out == out.read_text("utf-8")
    assert "51" in out.read_text("utf-8")
