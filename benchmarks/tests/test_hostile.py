"""Short runs of `hostile.py`: damaged maps and hostile pictures cause no traceback and no wrong position."""

import base
import hostile_maps
import hostile_pictures
import pytest
import walks

needs_sets = pytest.mark.skipif(not base.DATA.is_dir(), reason="the image sets of ../shared/data are missing")
# Forward pictures that nadir maps accepted when acceptance depended only on score and margin.
FORWARD_PICTURES = [f"nordland_tiny/query/{number}.png" for number in ("0216", "0222", "0291", "0324", "0330")]
FORWARD_PICTURES += ["grief_stromovka_seasons/query/0055.jpg", "grief_stromovka_seasons/ref/0035.jpg"]


def test_run_damaged_maps_reports_no_traceback_no_wrong_position_and_no_lost_place():
    rows = hostile_maps.run(2 * len(hostile_maps.KINDS), seed=11)
    assert [row["kind"] for row in rows] == list(hostile_maps.KINDS)
    for row in rows:
        assert (row["tried"], row["tracebacks"], row["wrong_positions"], row["places_lost"]) == (2, 0, 0, 0), row


@needs_sets
def test_map_of_downward_images_refuses_forward_images(tmp_path):
    folder = base.DATA / "aerial_brighton"
    recogniser = hostile_pictures.open_set_map(folder, tmp_path)
    with recogniser.place_map:
        assert not any(recogniser.step(walks.make_frame(base.DATA / path)).accepted for path in FORWARD_PICTURES)
        assert recogniser.step(walks.make_frame(min((folder / "query").iterdir()))).accepted


@needs_sets
def test_run_images_counts_each_kind_and_accepts_none_wrongly():
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
