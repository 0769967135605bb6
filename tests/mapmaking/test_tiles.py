"""Map tiles of caches, PMTiles and addresses: they give the picture that a folder of them gives, or a sentence."""

import contextlib
import http.server
import sqlite3
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

from rasterio.warp import transform
from rasters import HOME

from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import Position
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.mapmaking.tiles import ground_of
from edgevpr.places.mapfile import PlaceMap

HALF_WORLD_M = 20037508.342789244
ZOOM, REACH = 18, 2
SECRET = "mykey123"
HERE = ground_of([(HOME.lat_deg, HOME.lon_deg)], 100.0)


def tile(x: int, y: int, side_px: int = 256) -> bytes:
    """Ground without a seam that differs everywhere."""
    rng = np.random.default_rng((x, y))
    coarse = rng.integers(30, 220, (side_px // 8, side_px // 8, 3), np.uint8)
    return cv2.imencode(".png", cv2.resize(coarse, (side_px, side_px), interpolation=cv2.INTER_CUBIC))[1].tobytes()


def middle(zoom: int = ZOOM, at: Position = HOME) -> tuple[int, int]:
    (x_m,), (y_m,) = transform("EPSG:4326", "EPSG:3857", [at.lon_deg], [at.lat_deg])
    return tuple(int((HALF_WORLD_M + side_m) / (2 * HALF_WORLD_M) * 2**zoom) for side_m in (x_m, -y_m))


def around(zoom: int = ZOOM, at: Position = HOME, reach: int = REACH) -> list[tuple[int, int, int]]:
    x, y = middle(zoom, at)
    steps = range(-reach, reach + 1)
    return [(zoom, (x + i) % 2**zoom, y + j) for i in steps for j in steps]


def folder(path: Path, tiles) -> Path:
    for zoom, x, y in tiles:
        (path / f"{zoom}/{x}").mkdir(parents=True, exist_ok=True)
        (path / f"{zoom}/{x}/{y}.png").write_bytes(tile(x, y))
    return path


def mission_planner(path: Path, tiles, kind: int = 47626774) -> Path:
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute(
            "CREATE TABLE IF NOT EXISTS Tiles (id INTEGER NOT NULL PRIMARY KEY, X INTEGER NOT NULL, Y INTEGER NOT NULL,"
            " Zoom INTEGER NOT NULL, Type UNSIGNED INTEGER NOT NULL, CacheTime DATETIME)"
        )
        db.execute("CREATE TABLE IF NOT EXISTS TilesData (id INTEGER NOT NULL PRIMARY KEY, Tile BLOB NULL)")
        for zoom, x, y in tiles:
            row = db.execute("INSERT INTO Tiles(X, Y, Zoom, Type) VALUES (?, ?, ?, ?)", (x, y, zoom, kind)).lastrowid
            db.execute("INSERT INTO TilesData VALUES (?, ?)", (row, tile(x, y)))
    return path


def qgroundcontrol(path: Path, tiles, kind: int = 1553437234, name: str = "Bing Satellite") -> Path:
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute(
            "CREATE TABLE IF NOT EXISTS Tiles (tileID INTEGER PRIMARY KEY NOT NULL, hash TEXT NOT NULL UNIQUE, "
            "format TEXT NOT NULL, tile BLOB NULL, size INTEGER, type INTEGER, date INTEGER DEFAULT 0)"
        )
        db.execute("CREATE TABLE IF NOT EXISTS TileSets (setID INTEGER PRIMARY KEY, name TEXT UNIQUE, typeStr TEXT)")
        db.execute("CREATE TABLE IF NOT EXISTS SetTiles (setID INTEGER, tileID INTEGER)")
        of_set = db.execute("INSERT INTO TileSets(name, typeStr) VALUES (?, ?)", (name, name)).lastrowid
        for zoom, x, y in tiles:
            row = (f"{kind:010}{x:08}{y:08}{zoom:03}", "png", tile(x, y))
            number = db.execute("INSERT INTO Tiles(hash, format, tile) VALUES (?, ?, ?)", row).lastrowid
            db.execute("INSERT INTO SetTiles VALUES (?, ?)", (of_set, number))
        heights = (f"{77:010}{1:08}{1:08}{1:03}", "bin", b"heights")
        db.execute("INSERT OR IGNORE INTO Tiles(hash, format, tile) VALUES (?, ?, ?)", heights)
    return path


def pmtiles(path: Path, tiles, kind: str = "PNG") -> Path:
    writer = pytest.importorskip("pmtiles.writer", reason="pmtiles is not installed (pip install 'edgevpr[maps]')")
    from pmtiles.tile import Compression, TileType, zxy_to_tileid

    header = {"tile_type": TileType[kind], "tile_compression": Compression.NONE}
    header |= {"min_lon_e7": 118000000, "max_lon_e7": 120000000, "min_lat_e7": 499000000, "max_lat_e7": 501000000}
    with writer.write(str(path)) as out:
        for number, (_, x, y) in sorted((zxy_to_tileid(*each), each) for each in tiles):
            out.write_tile(number, tile(x, y))
        out.finalize(header, {})
    return path


def cut(source, ground=HERE, at=HOME, footprint_m: float = 100.0):
    orthophoto = Orthophoto(source, ground)
    try:
        return orthophoto.cut(at, footprint_m, 200)
    finally:
        orthophoto.close()


def refused(source, ground=HERE) -> str:
    with pytest.raises(EdgevprError) as caught:
        cut(source, ground)
    assert str(caught.value).endswith((".", "..."))
    assert SECRET not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("write", [mission_planner, qgroundcontrol, pmtiles])
def test_each_kind_of_file_gives_the_picture_of_a_folder(tmp_path, write):
    expected, _ = cut(folder(tmp_path / "folder", around()))
    for ground in (HERE, None) if write is not pmtiles else (HERE,):
        found, valid = cut(write(tmp_path / f"tiles{ground is None}", around()), ground)
        assert valid.all()
        assert np.array_equal(found, expected)


def test_a_cache_of_many_places_is_read_where_it_is_wanted_at_the_zoom_that_covers_it(tmp_path):
    elsewhere = around(20, Position(-35.0, 149.0), 1)
    patch = around(20, reach=0)
    path = mission_planner(tmp_path / "Data.gmdb", [*around(), *elsewhere, *patch])
    found, valid = cut(path)
    assert valid.all()
    assert np.array_equal(found, cut(folder(tmp_path / "folder", around()))[0])


def test_files_that_are_damaged_locked_foreign_or_empty_get_a_sentence(tmp_path):
    with contextlib.closing(sqlite3.connect(tmp_path / "foreign.db")) as db, db:
        db.execute("CREATE TABLE notes (text TEXT)")
    assert "cannot be opened as an orthophoto" in refused(tmp_path / "foreign.db")
    assert "no map tiles of the area" in refused(mission_planner(tmp_path / "empty.gmdb", []))
    broken = mission_planner(tmp_path / "broken.gmdb", around())
    data = bytearray(broken.read_bytes())
    data[100:4000] = b"\xff" * 3900
    broken.write_bytes(data)
    assert "copy of the file" in refused(broken)
    holed = mission_planner(tmp_path / "holed.gmdb", around())
    with contextlib.closing(sqlite3.connect(holed)) as db, db:
        x, y = middle()
        db.execute("UPDATE TilesData SET Tile = x'00' WHERE id IN (SELECT id FROM Tiles WHERE X = ? AND Y = ?)", (x, y))
    assert 0 < cut(holed)[1].mean() < 1


class Server(http.server.ThreadingHTTPServer):
    """Gives the tiles of one zoom and of those below, and says who has asked for what."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.status, self.asked, self.agents, self.body, self.most, self.now = 200, [], set(), None, 0, 0
        self.highest, self.lock, self.left = ZOOM, threading.Lock(), None

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/{{z}}/{{x}}/{{y}}.png?key={SECRET}"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        with server.lock:
            server.asked.append(self.path)
            server.agents.add(self.headers["User-Agent"])
            server.now += 1
            server.most = max(server.most, server.now)
            if server.left is not None:
                server.left -= 1
            status = server.status if server.left is None or server.left >= 0 else 503
        zoom, x, y = map(int, self.path.partition(".png")[0].split("/")[1:])
        if status == 200 and zoom > server.highest:
            status = 404
        time.sleep(0.005)  # so that those who ask at once meet
        body = b"" if status != 200 else server.body or tile(x, y)
        with server.lock:
            server.now -= 1
        self.answer(status, body)

    def answer(self, status, body):
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args):
        pass


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def everything_under(folder: Path) -> bytes:
    return b"".join(str(path).encode() + path.read_bytes() for path in folder.rglob("*") if path.is_file())


@pytest.mark.network
def test_an_address_gives_its_highest_zoom_and_nothing_is_asked_for_twice(tmp_path, server):
    expected, _ = cut(folder(tmp_path / "folder", around()))
    found, valid = cut(server.address)
    assert valid.all()
    assert np.array_equal(found, expected)
    assert len(server.asked) == len(set(server.asked))
    assert server.asked[0].startswith("/20/"), "100 m in 640 pixels, 50 degrees north"
    assert all(agent.startswith("edgevpr/") for agent in server.agents)
    asked = len(server.asked)
    server.status = 500
    assert np.array_equal(cut(server.address)[0], expected)
    assert len(server.asked) == asked
    assert SECRET.encode() not in everything_under(tmp_path / "cache")


@pytest.mark.network
@pytest.mark.parametrize(
    ("status", "said"),
    [(401, "key"), (403, "key"), (404, "zoom 18 to 20"), (429, "pause"), (500, "HTTP 500")],
)
def test_a_refusal_is_a_sentence_that_names_the_host_only(server, status, said):
    server.status = status
    found = refused(server.address)
    assert said in found
    assert "127.0.0.1" in found


@pytest.mark.network
def test_what_is_no_address_of_tiles_gets_a_sentence(server, monkeypatch):
    server.body = b"<html>log in</html>"
    assert "no picture" in refused(server.address)
    assert "must have {z}" in refused(server.address.replace("{y}", "7"))
    assert "no other braces" in refused(server.address.replace("127", "{s}"))
    assert "no host" in refused("https:///{z}/{x}/{y}.png")
    assert "--area" in refused(server.address, None)
    server.shutdown()
    server.server_close()
    assert "cannot be reached" in refused(server.address.replace("/{z}", "/a/{z}"))


@pytest.mark.network
@pytest.mark.slow
def test_a_map_of_an_address_resumes_and_keeps_its_owner_but_no_key(tmp_path, server, capsys, caplog):
    path = tmp_path / "m.gpkg"
    cut_from = ["--orthophoto", server.address, "--footprint-m", "100", "--spacing-m", "30", "--no-calibrate"]
    area = ["--area", f"{HOME.lat_deg},{HOME.lon_deg},40"]
    assert main(["map", "build", str(path), *cut_from, *area]) == 2
    assert "--attribution" in capsys.readouterr().err
    assert main(["map", "build", str(path), *cut_from, "--attribution", "Survey of X"]) == 2
    assert not server.asked
    server.left = 6
    whole = [*cut_from, *area, "--attribution", "Survey of X"]
    assert main(["map", "build", str(path), *whole]) == 1
    assert "HTTP 503" in capsys.readouterr().err
    assert not path.exists()
    before, server.left = set(server.asked[:6]), None
    server.asked.clear()
    with caplog.at_level("INFO"):
        assert main(["map", "build", str(path), *whole]) == 0
    assert not before & set(server.asked)
    assert server.most <= 2
    assert "places will be cut, of " in caplog.text
    assert "km2 of ground" in caplog.text
    with PlaceMap.open(path) as place_map:
        assert place_map.attribution == "Survey of X"
        assert all(place.source_image.startswith("127.0.0.1_r") for place in place_map.places())
    assert SECRET.encode() not in path.read_bytes()
    capsys.readouterr()
    asked = len(server.asked)
    page = ["--page", str(tmp_path / "m.html"), "--map-images", server.address]
    assert main(["map", "info", str(path), *page]) == 0
    out = capsys.readouterr()
    assert "Survey of X" in out.out
    assert len(server.asked) - asked <= 3
    assert SECRET not in (tmp_path / "m.html").read_text() + out.out + out.err + caplog.text
