"""The commands as a user types them, and one clear sentence for everything that is wrong."""

import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml
from commands import expect_refusal, list_commands, run, run_json
from pictures import draw_texture, write_flight

from edgevpr.cli.examples import EXAMPLES
from edgevpr.cli.main import EXIT_CODES, main, make_parser


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A folder of six pictures with positions, and the same six a little darker and shifted as queries."""
    folder = tmp_path_factory.mktemp("flight")
    pictures = [draw_texture(number, 240, 320) for number in range(6)]
    write_flight(folder / "ref", pictures)
    write_flight(folder / "query", [cv2.convertScaleAbs(np.roll(each, 9, axis=1), alpha=0.8) for each in pictures])
    return folder


@pytest.fixture(scope="module")
def valley(flight, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "valley.gpkg"
    assert main(["map", "build", str(path), "--images", str(flight / "ref"), "--technique", "cohog"]) == 0
    return path


@pytest.mark.slow
def test_match_finds_every_place_with_its_cost(capsys, flight, valley):
    found = run_json(capsys, "match", valley, "--images", flight / "query")
    assert [each["query"] for each in found] == [f"{n}.png" for n in range(6)]
    assert [each["place"]["image"] for each in found] == [f"{n}.png" for n in range(6)]
    for each in found:
        assert each["accepted"] is True
        assert 0 < each["score"] <= 1
        assert each["costs"]["t_encode_s"] > 0
        assert each["costs"]["used_mah"] > 0
    flags = ("--images", flight / "query", "--min-score", "0.9999")
    assert not any(each["accepted"] or each["position"] for each in run_json(capsys, "match", valley, *flags))
    place, fix = found[2]["place"], found[2]["position"]
    assert place == {"number": 3, "image": "2.png", "lat_deg": 50.002, "lon_deg": 8.0, "alt_m": None}
    assert (fix["lat_deg"], fix["lon_deg"], fix["of_place"]) == (50.002, 8.0, True), "ahead, nothing else is known"
    assert fix["accuracy_m"] == pytest.approx(111, abs=1), "the distance between places"
    assert found[2]["from_gps_tag_m"] == 0
    assert main(["match", str(valley), "--images", str(flight / "query")]) == 0
    assert "6 queries, 6 accepted" in capsys.readouterr().out


def test_map_build_appends_to_an_unfinished_map(capsys, flight, tmp_path):
    half = tmp_path / "half"
    half.mkdir()
    for number in range(3):
        shutil.copy(flight / "ref" / f"{number}.png", half)
    path = tmp_path / "m.gpkg"
    run_json(capsys, "map", "build", path, "--images", half, "--technique", "cohog", "--no-calibrate")
    built = run_json(capsys, "map", "build", path, "--images", flight / "ref", "--append", "--no-calibrate")
    assert (built["added"], built["already_here"], built["places"]) == (3, 3, 6)
    # Another flight, whose camera starts its numbers anew, is added too.
    built = run_json(capsys, "map", "build", path, "--images", flight / "query", "--append", "--no-calibrate")
    assert (built["added"], built["already_here"], built["places"]) == (6, 0, 12)


def test_map_build_names_unusable_images_and_maps_the_others(capsys, flight, tmp_path):
    folder = tmp_path / "mixed"
    shutil.copytree(flight / "ref", folder)
    (folder / "cut.png").write_bytes((folder / "0.png").read_bytes()[:2000])
    (folder / "text.jpg").write_text("no picture")
    cv2.imwrite(str(folder / "dot.png"), np.zeros((1, 1), np.uint8))
    cv2.imwrite(str(folder / "deep.tif"), np.zeros((40, 40), np.float32))
    path = tmp_path / "m.gpkg"
    assert main(["map", "build", str(path), "--images", str(folder), "--technique", "cohog"]) == 1
    said = capsys.readouterr().err
    for name in ("cut.png", "text.jpg", "dot.png", "deep.tif"):
        assert any(name in line for line in said.splitlines())
    assert run_json(capsys, "map", "info", path)["places"] == 6


def test_main_exits_with_1_and_a_sentence_if_an_input_is_bad(capsys, flight, valley, tmp_path):
    query = flight / "query"
    for argv, says in [
        (["match", tmp_path / "no.gpkg", "--images", query], "There is no map"),
        (["match", flight / "ref" / "0.png", "--images", query], "not a place map"),
        (["match", flight, "--images", query], f"edgevpr map subset {flight} --mission"),
        (
            ["run", "--map", flight, "--source", query, "--log", tmp_path / "x"],
            f"edgevpr map subset {flight} --mission",
        ),
        (["profile", "--map", flight], f"edgevpr map subset {flight} --mission"),
        (["map", "build", valley, "--images", query, "--technique", "cohog"], "exists already"),
        (["map", "build", tmp_path / "no" / "m.gpkg", "--images", query, "--technique", "cohog"], "check the path"),
        (["run", "--map", valley, "--source", query, "--log", tmp_path / "no" / "x.jsonl"], "flight log"),
    ]:
        assert says in expect_refusal(capsys, *argv, code=1)


def test_main_exits_with_2_and_a_sentence_if_the_request_is_wrong(capsys, flight, valley, tmp_path):
    query = flight / "query"
    config = tmp_path / "c.yaml"
    config.write_text("mach: {min_score: 1}\n")
    wrong_row = tmp_path / "positions.csv"
    wrong_row.write_text("file,lat,lon\n0.png,91,8\n")
    for argv, says in [
        (
            ["run", "--map", valley, "--source", query, "--log", tmp_path / "x", "--link", "udp:1"],
            "not a MAVLink address",
        ),
        (["match", valley, "--images", query, "--min-score", "3"], "between 0 and 1"),
        (["match", valley, "--images", query, "--accept-precision", "nan"], "`match.accept_precision` is"),
        (["match", valley, "--images", query, "--board", "rpi5"], "did you mean `rpi-5`"),
        (["run", "--config", config], "did you mean `match`"),
        (["run", "--map", valley], "no source of frames"),
        (["run", "--source", query], "no map"),
        (["map", "build", tmp_path / "m.gpkg", "--images", query, "--technique", "sift"], "There is no technique"),
        (["map", "build", tmp_path / "m.gpkg", "--images", query, "--param", "gt"], "must be KEY=VALUE"),
        (["map", "build", tmp_path / "m.gpkg", "--images", query, "--positions", wrong_row], "line 2: lat is `91`"),
        (["eval", "--query", query, "--ref", query, "--ground-truth", wrong_row, "--techniques", ","], "is empty"),
        (["eval", "--query", query, "--ref", query, "--ground-truth", wrong_row], "lacks the column `query_file`"),
    ]:
        assert says in expect_refusal(capsys, *argv)


@pytest.mark.slow
def test_main_exits_with_documented_codes_and_check_as_run_does(capsys, flight, valley, tmp_path):
    good = {"map": str(valley), "source": {"uri": str(flight / "query"), "rate_hz": 60}, "log": {"path": None}}
    table = [
        (0, {}),
        (1, {"map": str(tmp_path / "no.gpkg")}),
        (1, {"source": {"uri": str(tmp_path / "nowhere")}}),
        (1, {"log": {"path": str(tmp_path / "no" / "x.jsonl")}}),
        (1, {"technique": "hog"}),
        (2, {"map": None}),
        (2, {"source": {"uri": None}}),
        (2, {"board": "rpi5"}),
        (2, {"battery": {"pack": "lots"}}),
        (2, {"mavlink": {"link": "udp:1"}}),
        (2, {"mavlink": {"link": "udpin:127.0.0.1:0", "signing_key": str(tmp_path / "no.key")}}),
        (2, {"mach": {}}),
    ]
    path = tmp_path / "c.yaml"
    for code, change in table:
        path.write_text(yaml.safe_dump(good | change))
        ends = [main([*command, "--config", str(path)]) for command in (["check", "--offline", "--json"], ["run"])]
        assert ends == [code, code], (change, capsys.readouterr().err)
    words = [
        (0, ["map", "check", valley]),
        (1, ["map", "check", tmp_path / "no.gpkg"]),
        (1, ["top", "--once", "--file", tmp_path / "no.json"]),
        (2, ["report", tmp_path / "no.jsonl", "--out", tmp_path / "r.html"]),
        (2, ["replay", tmp_path / "no.jsonl"]),
        (2, ["doctor"]),
    ]
    for code, argv in words:
        assert run(*argv) == code, argv
    assert {code for code, _ in table + words} < set(EXIT_CODES)


def test_debug_shows_the_traceback(capsys, caplog, tmp_path):
    with caplog.at_level("DEBUG"):
        assert main(["--debug", "map", "info", str(tmp_path / "no.gpkg")]) == 1
    assert any(record.exc_info for record in caplog.records)


def test_quiet_shows_no_progress(capsys, flight, tmp_path):
    words = ["map", "build", "--images", flight / "ref", "--technique", "hog"]
    assert main([*map(str, words), str(tmp_path / "one.gpkg")]) == 0
    assert "mapping" in capsys.readouterr().err
    assert main(["-q", *map(str, words), str(tmp_path / "two.gpkg")]) == 0
    assert "mapping" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["mpa"], "map"),
        (["map", "biuld"], "build"),
        (["map", "info", "m.gpkg", "--jsno"], "--json"),
        (["match", "m.gpkg", "--images", "x", "--positons=p.csv"], "--positions"),
    ],
)
def test_main_suggests_a_word_for_a_wrong_one(capsys, words, meant):
    with pytest.raises(SystemExit) as exit_code:
        main(words)
    assert exit_code.value.code == 2
    assert f"`{meant}`" in capsys.readouterr().err


def test_help_of_every_command_has_examples_that_parse():
    commands = dict(list_commands(make_parser()))
    assert set(commands) == set(EXAMPLES)
    for command, examples in EXAMPLES.items():
        assert all(line in commands[command].format_help() for _, line in examples)
        for _, words in examples:
            make_parser().parse_args([*command.split(), *words.split()])


@pytest.mark.process
def test_program_completes_a_line_for_the_shell(tmp_path):
    line = "edgevpr match --kn"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    asked["_ARGCOMPLETE_STDOUT_FILENAME"] = str(tmp_path / "said")
    subprocess.run([sys.executable, "-m", "edgevpr"], env=os.environ | asked, timeout=60)
    assert (tmp_path / "said").read_text().strip() == "--known"
