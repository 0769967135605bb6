"""Short runs of `hostile.py`: what a hostile world may not bring about does not come about."""

import base
import hostile_bytes
import hostile_flights
import hostile_links
import hostile_maps
import hostile_pictures
import pytest
import walks

needs_sets = pytest.mark.skipif(not base.DATA.is_dir(), reason="the image sets of ../shared/data are not there")
# Views ahead that were accepted as places of maps made looking down, when only score and margin were asked.
AHEAD = [f"nordland_tiny/query/{number}.png" for number in ("0216", "0222", "0291", "0324", "0330")]
AHEAD += ["grief_stromovka_seasons/query/0055.jpg", "grief_stromovka_seasons/ref/0035.jpg"]
STREAM = "MJPEG over HTTP, truncated"


def test_no_byte_and_no_packet_raises_and_nothing_forged_is_believed():
    rows = {row["kind"]: row for row in hostile_bytes.run(count=3000, seed=5)}
    assert [row["exceptions"] for row in rows.values()] == [0] * len(rows)
    assert rows["any content, right checksum"]["believed"] == 3001, "nothing came through, so nothing was tried"
    assert rows["signed, any content"]["believed"] == 3001
    assert rows["forged, old, replayed or unsigned"]["believed"] == 1, "the autopilot's own first heartbeat"


def test_no_hostile_link_gets_a_fix_that_is_not_its_own_or_a_late_one():
    rows = hostile_links.run(count=80, seed=11)
    for row in rows:
        assert (row["foreign"], row["late"], row["exceptions"]) == (0, 0, 0), row
        assert row["left"], "ours got none, so nothing was tried"
    silent = next(row for row in rows if row["kind"] == "reads nothing for 60 s (usual buffer)")
    assert (silent["fixes"], silent["left"] <= 10) == (180, True), "five, and one every ten seconds"


def test_no_damaged_map_gives_a_traceback_or_a_wrong_position_or_loses_a_place():
    rows = hostile_maps.run(2 * len(hostile_maps.KINDS), seed=11)
    assert [row["kind"] for row in rows] == list(hostile_maps.KINDS)
    for row in rows:
        assert (row["tried"], row["tracebacks"], row["wrong_positions"], row["places_lost"]) == (2, 0, 0, 0), row


def test_a_flight_behind_a_damaged_stream_sends_no_fix_from_an_old_picture(monkeypatch):
    monkeypatch.setattr(hostile_flights, "_TECHNIQUE", (*hostile_flights._TECHNIQUE, "--no-calibrate"))  # half a minute
    damaged, total = hostile_flights.run(count=720, seed=3, only=STREAM.__eq__)
    assert (damaged["stream"], damaged["sent"], damaged["fixes"] > 0) == (STREAM, 720, True)
    assert (damaged["old"], damaged["ahead"], total["old"]) == (0, 0, 0)


@needs_sets
def test_a_map_made_looking_down_knows_that_a_view_ahead_is_none_of_its_places(tmp_path):
    folder = base.DATA / "aerial_brighton"
    recogniser = hostile_pictures.mapped(folder, tmp_path)
    with recogniser.place_map:
        assert not any(recogniser.step(walks.frame(base.DATA / path)).accepted for path in AHEAD)
        assert recogniser.step(walks.frame(min((folder / "query").iterdir()))).accepted


@needs_sets
def test_a_run_of_pictures_counts_every_kind_and_nothing_wrong_is_accepted():
    rows = hostile_pictures.run(count=2, seed=31, names=["corridor"])
    assert [(row["kind"], row["tried"]) for row in rows] == [
        ("of nothing", 2),
        ("spoilt", 11),
        ("of other sites", 2),
        ("of the other camera", 2),
        ("its own behind a display", 2),
        ("of other sites behind a display", 2),
        ("its own behind figures", 2),
        ("of other sites behind figures", 2),
    ]
    assert sum(row["accepted_wrong"] for row in rows) == 0
    assert rows == hostile_pictures.run(count=2, seed=31, names=["corridor"])
