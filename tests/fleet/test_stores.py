"""Photographs in an object store: a real S3 server (of moto), a process of its own, asked by s3fs."""

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import cv2
import pytest
from pictures import textured

from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.places.mapfile import PlaceMap

for _name in ("distributed", "pyogrio", "fsspec"):
    pytest.importorskip(_name, reason="needs the extra `fleet`")
for _name in ("s3fs", "boto3", "moto", "flask"):
    pytest.importorskip(_name, reason="needs `pip install s3fs 'moto[server]'`")
pytestmark = [pytest.mark.process, pytest.mark.network, pytest.mark.slow]
_ROOT = Path(__file__).parents[2]
_COUNT, _MISSING = 6, "s3://flights/monday/none.png"
_START_S = 60


class Store:
    """An S3 server with photographs, that can be killed. It lets in everybody, or whoever has the key of its user."""

    def __init__(self, folder):
        self.log = folder / "store.log"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.port, self.address = port, f"http://127.0.0.1:{port}"
        self.key = {"AWS_ACCESS_KEY_ID": "anybody", "AWS_SECRET_ACCESS_KEY": "anything"}

    def start(self):
        with open(self.log, "ab") as log:
            words = [sys.executable, "-W", "ignore", "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)]
            self.process = subprocess.Popen(words, stdout=log, stderr=log)
        last_s = time.monotonic() + _START_S
        while self.process.poll() is None and time.monotonic() < last_s:
            try:
                self._asked("/moto-api/data.json")
                break
            except OSError:
                time.sleep(0.1)
        s3 = self.client("s3")
        s3.create_bucket(Bucket="flights")
        for number in range(_COUNT):
            image = cv2.imencode(".png", textured(number, 384, 384))[1].tobytes()
            s3.put_object(Bucket="flights", Key=f"monday/{number}.png", Body=image)

    def _asked(self, path, data=None):
        request = urllib.request.Request(self.address + path, data, {"Content-Type": "text/plain"})
        with urllib.request.urlopen(request):
            pass

    def client(self, kind):
        import boto3

        keys = {name.lower(): value for name, value in self.key.items()}
        return boto3.client(kind, endpoint_url=self.address, region_name="us-east-1", **keys)

    def ask_for_keys(self):
        iam, of_bucket = self.client("iam"), {"Effect": "Allow", "Action": "s3:*", "Resource": "*"}
        iam.create_user(UserName="pilot")
        key = iam.create_access_key(UserName="pilot")["AccessKey"]
        policy = json.dumps({"Version": "2012-10-17", "Statement": [of_bucket]})
        iam.put_user_policy(UserName="pilot", PolicyName="reads", PolicyDocument=policy)
        self.key = {"AWS_ACCESS_KEY_ID": key["AccessKeyId"], "AWS_SECRET_ACCESS_KEY": key["SecretAccessKey"]}
        self._asked("/moto-api/reset-auth", b"0")

    def stop(self):
        self.process.kill()
        self.process.wait()


@pytest.fixture
def store(tmp_path):
    """A store, and a table of its photographs, 300 m apart, and of one that is not there."""
    uris = [f"s3://flights/monday/{number}.png" for number in range(_COUNT)]
    tags = {uri: GeoTag(position=Position(47.0, 8.0 + 0.004 * number)) for number, uri in enumerate([*uris, _MISSING])}
    write_positions(tmp_path / "table.csv", tags)
    store = Store(tmp_path)
    try:
        store.start()
        yield store
    finally:
        store.stop()


def started(store, folder, **more):
    """Start a run over the table; it reaches the store by nothing but the environment."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(_ROOT), *sys.path]), "HOME": str(folder)}
    env |= {"AWS_ENDPOINT_URL": store.address, "AWS_DEFAULT_REGION": "us-east-1", **store.key, **more}
    words = ["fleet", "build", folder / "maps", "--images", folder / "table.csv", "--camera", "nadir", "--workers", "1"]
    words += ["--no-refine", "--no-calibrate", "--places-per-tile", "2", "--json"]
    done = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-m", "edgevpr", *map(str, words)], stdout=done, stderr=done, env=env)


def ended(process):
    text, told = process.communicate(timeout=300)
    assert b"Traceback" not in told
    return json.loads(text)


def places_in(folder):
    names = []
    for path in folder.glob("[0-3]*.gpkg"):
        with PlaceMap.open(path) as place_map:
            names += [place.source_image.rpartition("_")[0] for place in place_map.places()]
    return sorted(names)


ALL = [f"monday_{number}" for number in range(_COUNT)]


def test_photographs_are_read_from_a_store_by_whoever_has_its_key(store, tmp_path):
    store.ask_for_keys()
    found = ended(started(store, tmp_path, AWS_SECRET_ACCESS_KEY="wrong"))
    assert (found["places"], places_in(tmp_path / "maps")) == (0, [])
    assert len(found["problems"]) >= 3
    assert all("cannot be read (Forbidden)" in problem for problem in found["problems"].values())
    found = ended(started(store, tmp_path))
    assert (found["places"], found["problems"], places_in(tmp_path / "maps")) == (_COUNT, {}, ALL)
    assert found["unusable"] == [f"{_MISSING} is not there: correct the table, or bring it back"]


def test_a_store_that_goes_away_leaves_whole_tiles_and_the_next_run_goes_on(store, tmp_path):
    run = started(store, tmp_path)
    while not list((tmp_path / "maps").glob("[0-3]*.gpkg")):
        assert run.poll() is None
    store.stop()
    found = ended(run)
    assert 0 < found["mapped_now"] < found["mapped_now"] + len(found["problems"])
    assert all("Could not connect to the endpoint" in problem for problem in found["problems"].values())
    left = places_in(tmp_path / "maps")
    assert left == sorted(set(left))
    again = ended(started(store, tmp_path))
    assert (again["mapped_now"], places_in(tmp_path / "maps")) == (0, left), "no map is replaced by one of less"
    store.start()
    last = ended(started(store, tmp_path))
    assert (last["problems"], places_in(tmp_path / "maps")) == ({}, ALL)
    assert last["mapped_now"] < last["tiles"]
