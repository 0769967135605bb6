"""Maps made tile by tile: by a real scheduler and real workers, each a process of its own."""

import json
import logging
import os
import signal
import subprocess
import sys
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pictures import textured
from rasters import textured_raster

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.core.errors import MapBusyError, MapError, UsageError
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.mapmaking import calibrate
from edgevpr.mapmaking.cuttings import NoPlaceError
from edgevpr.mapmaking.making import Cuttings
from edgevpr.places.mapfile import PlaceMap

building = pytest.importorskip("edgevpr.fleet.building", reason="needs the extra `fleet`")
photos = pytest.importorskip("edgevpr.fleet.photos")
worker = pytest.importorskip("edgevpr.fleet.worker")
distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.slow
PER_TILE = 10


def unshown(items, total, label):
    return items


@contextmanager
def started():
    """A scheduler and two workers, each a process."""
    silent = {"silence_logs": logging.CRITICAL, "dashboard_address": ":0"}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **silent) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def cluster():
    with started() as cluster:
        yield cluster.scheduler_address


def order(out, **more):
    settings = {"refine": False, "calibrate": False, **more}
    return worker.FleetOrder(out=out, config=load_config(None), camera="nadir", **settings)


def cuttings(path):
    return Cuttings(orthophoto=str(path), footprint_m=80.0, spacing_m=40.0)


def mapped(cluster, out, tasks, **more):
    return list(building.build(order(out, **more), tasks, cluster, None, unshown))


def places_of(folder):
    """The names of the places of all tiles, by the tile."""
    found = {}
    for path in building.list_maps(folder):
        with PlaceMap.open(path) as place_map:
            found[path.stem] = sorted(place.source_image for place in place_map.places())
    return found


@pytest.fixture(scope="module")
def orthophoto(tmp_path_factory):
    return textured_raster(tmp_path_factory.mktemp("raster") / "o.tif", side_px=720)


@pytest.fixture(scope="module")
def tiled(cluster, orthophoto, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiled") / "maps"
    tasks = building.tasks_of_orthophoto(cuttings(orthophoto), PER_TILE, None)
    return out, tasks, mapped(cluster, out, tasks)


def test_every_place_of_an_orthophoto_is_in_one_tile(tiled, orthophoto):
    out, _, done = tiled
    assert not [each.problem for each in done if each.problem]
    found = places_of(out)
    source = cuttings(orthophoto).open()
    names = [frame.name for frame in iter(lambda: source.read(1.0), None)]
    assert sorted(name for each in found.values() for name in each) == sorted(names)
    assert max(map(len, found.values())) <= PER_TILE
    assert len(found) > 4


def test_a_second_run_maps_nothing_and_one_over_changed_ground_what_has_changed(cluster, orthophoto, tmp_path):
    path, out = tmp_path / "o.tif", tmp_path / "maps"
    path.write_bytes(orthophoto.read_bytes())
    tasks = building.tasks_of_orthophoto(cuttings(path), PER_TILE, None)
    assert all(each.is_new for each in mapped(cluster, out, tasks) if each.places)
    assert not any(each.is_new for each in mapped(cluster, out, tasks))
    with rasterio.open(path, "r+") as raster:  # a house more, in the north-west
        raster.write(np.full((1, 20, 20), 255, np.uint8), window=rasterio.windows.Window(30, 30, 20, 20))
    again = mapped(cluster, out, tasks)
    assert 1 <= sum(each.is_new for each in again) < sum(each.places > 0 for each in again)


def test_a_tile_is_calibrated_with_the_ground_around_it_which_it_does_not_keep(orthophoto, tmp_path, monkeypatch):
    for name in ("ASKED_DOWN", "FEWEST_PLACES"):  # each takes a while
        monkeypatch.setattr(calibrate, name, 6)
    (tmp_path / "maps").mkdir()
    tasks = building.tasks_of_orthophoto(replace(cuttings(orthophoto), spacing_m=70.0), 9, None)
    task = next(task for task in tasks if 0 < len(cut_of(task)) < 6)
    done = worker.build_tile(task, order(tmp_path / "maps", calibrate=True))
    assert done.problem is None
    assert places_of(tmp_path / "maps")[task.tile.name] == cut_of(task)
    assert done.is_calibrated


def cut_of(task):
    """The names of the pictures that are cut in a tile."""
    try:
        source = task.cuttings.open()
    except NoPlaceError:
        return []
    with closing(source):
        return sorted(frame.name for frame in iter(lambda: source.read(1.0), None))


def test_a_worker_that_dies_costs_its_tile_some_time(orthophoto, tmp_path):
    done, made, out = [], {}, tmp_path / "maps"
    tasks = building.tasks_of_orthophoto(cuttings(orthophoto), PER_TILE, None)
    with started() as cluster:
        first = cluster.workers[0].process
        for each in building.build(order(out), tasks, cluster.scheduler_address, None, unshown):
            done.append(each)
            if sum(each.places > 0 for each in done) == 3 and not made:
                made = {
                    path: path.stat().st_ino for path in (out / f"{each.name}.gpkg" for each in done if each.places)
                }
                os.kill(first.pid, signal.SIGKILL)
    assert not [each.problem for each in done if each.problem]
    names = [name for each in places_of(out).values() for name in each]
    assert len(names) == len(set(names)) == sum(each.places for each in done)
    assert len(names) == cuttings(orthophoto).open().total
    assert {path: path.stat().st_ino for path in made} == made, "what was done is not done again"
    assert not list(out.glob(".*.gpkg.*"))


def photographs(folder, names, first):
    """Write photographs 30 m apart to the east, and their positions."""
    folder.mkdir()
    tags = {}
    for number, name in enumerate(names, start=first):
        cv2.imwrite(str(folder / name), textured(number, 384, 384))
        tags[name] = GeoTag(position=Position(47.0, 8.0 + number * 0.0004))
    write_positions(folder / "positions.csv", tags)


def test_photographs_of_several_folders_and_a_table_are_mapped_where_they_were_taken(cluster, tmp_path):
    names = [f"DJI_{number:04d}.png" for number in range(8)]
    for number, folder in enumerate(("monday", "tuesday", "wednesday")):
        photographs(tmp_path / folder, names, 8 * number)
    (tmp_path / "monday" / names[3]).write_bytes(b"broken")
    (tmp_path / "tuesday" / "none.png").write_bytes((tmp_path / "tuesday" / names[0]).read_bytes())
    table = tmp_path / "wednesday.csv"
    lines = (tmp_path / "wednesday" / "positions.csv").read_text().splitlines()
    lines[1:] = [line.replace("DJI_", "wednesday/DJI_", 1) for line in lines[1:]]
    table.write_text("\n".join([*lines, lines[-1].replace("_0007", "_0099")]))
    sources = [str(tmp_path / "monday"), str(tmp_path / "tuesday"), str(table)]
    tasks, without_position = building.tasks_of_photos(photos.list_photos(sources), 10, None)
    assert without_position == 1
    done = mapped(cluster, tmp_path / "maps", tasks)
    unusable = " ".join(text for each in done for text in each.unusable)
    assert "DJI_0099.png is not there" in unusable
    assert "DJI_0003.png" in unusable
    found = [name.rpartition("_")[0] for each in places_of(tmp_path / "maps").values() for name in each]
    there = {f"{folder}_{name[:8]}" for folder in ("monday", "tuesday", "wednesday") for name in names}
    assert sorted(found) == sorted(there - {"monday_DJI_0003"})
    assert not any(each.is_new for each in mapped(cluster, tmp_path / "maps", tasks))


def test_a_run_that_does_not_name_what_was_mapped_before_replaces_nothing(cluster, tmp_path):
    out = tmp_path / "maps"
    folders = [str(tmp_path / name) for name in ("monday", "tuesday")]
    for number, folder in enumerate(folders):
        photographs(Path(folder), ["1.png", "2.png"], 2 * number)
    mapped(cluster, out, building.tasks_of_photos(photos.list_photos(folders[:1]), 10, None)[0])
    before = places_of(out)
    (done,) = mapped(cluster, out, building.tasks_of_photos(photos.list_photos(folders[1:]), 10, None)[0])
    assert "has 2 pictures that this run does not name, such as monday_" in done.problem
    assert places_of(out) == before
    mapped(cluster, out, building.tasks_of_photos(photos.list_photos(folders), 10, None)[0])
    assert sum(map(len, places_of(out).values())) == 4


def test_photographs_that_are_moved_or_named_twice_are_neither_mapped_again_nor_twice(cluster, tmp_path):
    out, cards = tmp_path / "maps", [tmp_path / card / "DCIM" for card in "ab"]
    for number, card in enumerate(cards):
        card.parent.mkdir()
        photographs(card, ["1.png", "2.png"], 2 * number)

    def placed(*sources):
        done = mapped(cluster, out, building.tasks_of_photos(photos.list_photos(list(map(str, sources))), 10, None)[0])
        assert not [each for each in done if each.problem or each.unusable]
        return sum(map(len, places_of(out).values())), any(each.is_new for each in done)

    assert placed(*cards, cards[0]) == (4, True)
    (tmp_path / "a").rename(tmp_path / "archive")
    moved = tmp_path / "archive" / "DCIM"
    assert placed(moved, cards[1]) == (4, False)
    lines = (moved / "positions.csv").read_text().splitlines()
    table = tmp_path / "table.csv"
    table.write_text("\n".join([lines[0], *(f"archive/DCIM/{line}" for line in lines[1:])]))
    assert placed(table, moved, cards[1]) == (4, False)
    photographs(tmp_path / "c", ["1.png"], 5)
    assert placed(table, cards[1], tmp_path / "c") == (5, True)


def test_a_photograph_of_two_positions_is_refused_or_left_out(tmp_path):
    photographs(tmp_path / "a", ["1.png"], 0)
    table, elsewhere = tmp_path / "a.csv", GeoTag(position=Position(47.0, 8.001))
    write_positions(table, {"a/1.png": elsewhere})
    with pytest.raises(UsageError, match=r"1\.png has one position in .*a and another in .*a\.csv"):
        photos.list_photos([str(tmp_path / "a"), str(table)])
    (tmp_path / "b.png").write_bytes((tmp_path / "a" / "1.png").read_bytes())
    write_positions(table, {"b.png": elsewhere})
    (tmp_path / "here").mkdir()
    found = photos.gather(photos.list_photos([str(tmp_path / "a"), str(table)]), tmp_path / "here")
    assert len(found.paths) == 1
    assert "and has another position" in found.unusable[str(tmp_path / "b.png")]


def test_two_runs_into_one_folder_are_refused(tmp_path, cluster, tiled):
    out, tasks, _ = tiled
    first = building.build(order(out), tasks, cluster, None, unshown)
    next(first)
    with pytest.raises(MapBusyError, match="another run is mapping into it"):
        mapped(cluster, out, tasks)
    first.close()


def test_a_tile_of_another_technique_is_refused(tiled, cluster):
    out, tasks, _ = tiled
    ahead = replace(order(out), camera="forward")
    with pytest.raises(MapError, match="camera is nadir, not forward"):
        list(building.build(ahead, tasks, cluster, None, unshown))


def test_a_worker_of_another_version_maps_nothing(tiled, cluster, tmp_path):
    _, tasks, _ = tiled
    done = mapped(cluster, tmp_path / "maps", tasks[:2], version="99.0")
    assert [each.places for each in done] == [0, 0]
    assert "99.0 asks: install the same on all machines" in done[0].problem


def test_photographs_on_both_sides_of_the_date_line_have_neighbours_across_it():
    at = [Position(0.5, 179.9999), Position(0.5, -179.9999)]
    tasks, _ = building.tasks_of_photos({f"/{n}.jpg": GeoTag(position=each) for n, each in enumerate(at)}, 10, 12)
    assert [(len(task.photos), len(task.inside)) for task in tasks] == [(2, 1), (2, 1)]


def test_the_command_works_on_a_laptop_with_nothing_set_up(tmp_path, capsys):
    photographs(tmp_path / "photos", [f"{number}.png" for number in range(4)], 0)
    words = ["fleet", "build", str(tmp_path / "maps"), "--images", str(tmp_path / "photos"), "--workers", "1"]
    assert main(words) == 2
    assert "Where did the camera look?" in capsys.readouterr().err
    done = subprocess.run(
        [sys.executable, "-m", "edgevpr", *words, "--camera", "nadir", "--json"],
        capture_output=True,
        text=True,
        env={**os.environ, "HOME": str(tmp_path)},
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["places"], result["mapped_now"], result["problems"]) == (4, result["tiles"], {})
