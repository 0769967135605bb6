"""Map tiles of folders and addresses: they give the ground, or a sentence."""

import http.server
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rasterio", reason="rasterio is not installed (pip install 'edgevpr[maps]')")

from pictures import textured
from rasterio.warp import transform
from rasters import HOME

from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError, ImageError
from edgevpr.core.types import Position
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.mapmaking.tiles import surround
from edgevpr.places.mapfile import PlaceMap

HALF_WORLD_M = 20037508.342789244
ZOOM = 18
REACH = 2
SECRET = "mykey123"
HERE = surround([(HOME.lat_deg, HOME.lon_deg)], 100.0)


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


def joined(path: Path, from_south: bool = False, says_from_south: bool = False) -> Path:
    """Write tiles of one ground, whose rows join; their y counts from the south, and a file says so, or not."""
    ground = textured(1, 5 * 256, 5 * 256)
    left, top = (number - REACH for number in middle())
    for zoom, x, y in around():
        (path / f"{zoom}/{x}").mkdir(parents=True, exist_ok=True)
        row, column = 256 * (y - top), 256 * (x - left)
        named_y = 2**zoom - 1 - y if from_south else y
        cv2.imwrite(str(path / f"{zoom}/{x}/{named_y}.png"), ground[row : row + 256, column : column + 256])
    if says_from_south:
        (path / "tilemapresource.xml").write_text('<TileMap version="1.0.0"/>')
    return path


def test_a_folder_counts_its_rows_as_its_tiles_join_or_is_refused(tmp_path):
    expected, valid = cut(joined(tmp_path / "xyz"))
    assert valid.all()
    found, _ = cut(joined(tmp_path / "tms", from_south=True, says_from_south=True))
    assert np.array_equal(found, expected)
    assert "gdal2tiles --xyz" in refused(joined(tmp_path / "silent", from_south=True))
    assert "remove it" in refused(joined(tmp_path / "wrong", says_from_south=True))


def test_a_folder_may_mix_formats_and_have_gaps_and_damage_is_named(tmp_path):
    x, y = middle()
    path = folder(tmp_path / "a folder #1", around()) / f"{ZOOM}/{x}/{y}.png"
    expected, _ = cut(tmp_path / "a folder #1")
    path.rename(path.with_suffix(".PNG"))
    (path.parent / "notes.txt").write_text("no tile")
    grey = path.with_name(f"{y - 1}.png")
    grey.write_bytes(cv2.imencode(".webp", np.full((256, 256), 90, np.uint8))[1].tobytes())
    found, valid = cut(tmp_path / "a folder #1")
    assert valid.all()
    assert np.array_equal(found[120:], expected[120:])
    path.with_suffix(".PNG").unlink()
    assert 0 < cut(tmp_path / "a folder #1")[1].mean() < 1
    path.write_bytes(b"nothing")
    with pytest.raises(ImageError, match="copy the file again"):
        cut(tmp_path / "a folder #1")


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
    assert len(server.asked) <= len(set(server.asked)) + 1, "the tile in the middle says which zooms there are"
    assert server.asked[0].startswith("/20/"), "100 m in 640 pixels, 50 degrees north"
    assert all(agent.startswith("edgevpr/") for agent in server.agents)
    server.asked.clear()
    assert np.array_equal(cut(server.address)[0], expected)
    assert len(server.asked) == 3, "to see which zooms there are"
    assert SECRET.encode() not in everything_under(tmp_path / "cache")


@pytest.mark.network
@pytest.mark.parametrize(
    ("status", "said"),
    [(401, "key"), (403, "key"), (404, "zoom 18 to 20"), (429, "wait (429"), (500, "HTTP 500")],
)
def test_a_refusal_is_a_sentence_that_names_the_host_only(server, status, said):
    server.status = status
    found = refused(server.address)
    assert said in found
    assert "127.0.0.1" in found


@pytest.mark.network
def test_what_is_no_address_of_tiles_gets_a_sentence(server, monkeypatch):
    server.body = b"<html>log in</html>"
    assert "no tile" in refused(server.address)
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
    assert "does not give all tiles" in capsys.readouterr().err
    assert not path.exists()
    before, server.left = set(server.asked[:6]), None
    server.asked.clear()
    with caplog.at_level("INFO"):
        assert main(["map", "build", str(path), *whole]) == 0
    assert len(before & set(server.asked)) <= 3, "to see which zooms there are"
    assert server.most <= 2
    assert "places will be cut: " in caplog.text
    assert "km2 of ground" in caplog.text
    with PlaceMap.open(path) as place_map:
        assert place_map.attribution == "Survey of X"
        assert all(place.source_image.startswith("127.0.0.1_r") for place in place_map.read_places())
    assert SECRET.encode() not in path.read_bytes()
    capsys.readouterr()
    asked = len(server.asked)
    page = ["--page", str(tmp_path / "m.html"), "--map-images", server.address]
    assert main(["map", "info", str(path), *page]) == 0
    out = capsys.readouterr()
    assert "Survey of X" in out.out
    assert len(server.asked) - asked <= 3
    assert SECRET not in (tmp_path / "m.html").read_text() + out.out + out.err + caplog.text
