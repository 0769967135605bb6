"""What is known of a query beside its picture: `eval` and `match` with --known."""

import cv2
import pytest
from commands import expect_refusal, run, run_json
from pictures import draw_view

from edgevpr.runtime.recognise.hints import RECORDED_REACH_M

pytestmark = pytest.mark.slow

PLACES = 6
DEG_PER_M = 1 / 111_195  # of latitude


def make_set(folder, rotation_deg=(None,) * PLACES, places_known=True):
    """A set of places 200 m apart, mapped from 100 m, and a query over each. `rotation_deg` is what positions.csv says
    of the heading of each query, truly that of its place, less that of the place; None: nothing."""
    rows, truth = ["file,lat,lon,yaw_deg,height_m"], ["query_file,ref_files"]
    for side in ("query", "ref"):
        (folder / side).mkdir(parents=True)
    for place in range(PLACES):
        where = f"{50 + 200 * place * DEG_PER_M:.7f},8"
        cv2.imwrite(str(folder / "ref" / f"r{place}.png"), draw_view(place, 1.0))
        cv2.imwrite(str(folder / "query" / f"q{place}.png"), cv2.convertScaleAbs(draw_view(place, 1.0), alpha=0.8))
        rows.append(f"r{place}.png,{where},{50 * place},100" if places_known else f"r{place}.png,,,,")
        turned = rotation_deg[place]
        rows.append(f"q{place}.png,{where},{'' if turned is None else 50 * place + turned},")
        truth.append(f"q{place}.png,r{place}.png")
    (folder / "positions.csv").write_text("\n".join(rows) + "\n")
    (folder / "ground_truth.csv").write_text("\n".join(truth) + "\n")
    return folder


def evaluate(capsys, folder, *argv):
    flags = ("--data", folder, "--techniques", "cohog", "--camera", "nadir", "--param", "cohog.w1=256")
    return run_json(capsys, "eval", *flags, *argv)["techniques"]["cohog"]


def test_eval_with_known_headings_rules_out_other_rotations(capsys, tmp_path):
    folder = make_set(tmp_path / "set", rotation_deg=(90, 90, 90, 0, 0, None))
    without = evaluate(capsys, folder)
    assert (without["known"], without["accepted"]) == (None, PLACES)
    told = evaluate(capsys, folder, "--known", "heading")
    assert (told["known"], told["accepted"], told["accepted_wrong"]) == ("heading", 3, 0)


def test_match_reports_the_hints_of_each_query(capsys, tmp_path):
    folder = make_set(tmp_path / "set", rotation_deg=(0, 0, 0, 90, 90, None))
    path = tmp_path / "m.gpkg"
    build = ("map", "build", path, "--images", folder / "ref", "--technique", "cohog", "--camera", "nadir")
    assert run(*build, "--no-calibrate") == 0
    match = ("match", path, "--images", folder / "query")
    assert all(each["accepted"] and "hints" not in each for each in run_json(capsys, *match))
    found = run_json(capsys, *match, "--known", "reach, heading")
    assert [each["hints"]["heading"] for each in found] == [True] * 5 + [False]
    assert {each["hints"]["reach_m"] for each in found} == {RECORDED_REACH_M}
    assert [each["accepted"] for each in found] == [True] * 3 + [False, False, True]
    bare = make_set(tmp_path / "bare")
    assert "yaw_deg" in expect_refusal(capsys, "match", path, "--images", bare / "query", "--known", "heading")


@pytest.mark.parametrize(
    ("known", "places_known", "more", "said"),
    [
        ("heading", True, (), "yaw_deg"),
        ("height,reach", False, (), "`reach`"),
        ("height,speed", True, (), "`speed`"),
        ("height", True, ("--sequence", "2"), "2 queries"),
    ],
)
def test_eval_refuses_known_data_that_is_missing(capsys, tmp_path, known, places_known, more, said):
    folder = make_set(tmp_path / "set", places_known=places_known)
    assert said in expect_refusal(capsys, "eval", "--data", folder, "--techniques", "cohog", "--known", known, *more)
