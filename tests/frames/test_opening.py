"""What cannot be opened is said with its cause; what FFmpeg does not open by itself is opened all the same."""

import base64
import contextlib
import socket
import threading
import time
from statistics import median

import pytest
from answering_cameras import (
    HEIGHT,
    RATE_HZ,
    WIDTH,
    Server,
    answer_http,
    answer_multipart,
    answer_rtsp,
    draw_picture,
    encode_image,
    read_request,
    send_rtp,
)
from loopback import PATIENCE_S, free_port, wait_until

from edgevpr.core.config import load_config
from edgevpr.core.errors import SourceError
from edgevpr.frames import streams
from edgevpr.frames.devices import open_device
from edgevpr.frames.shot import Condition, OpeningError, Shot
from edgevpr.frames.source import open_source
from edgevpr.runtime.service import camera
from edgevpr.runtime.service.findingcodes import FindingCode

pytestmark = pytest.mark.network
PASSWORD = "geh%23heim"


@pytest.fixture
def serve():
    """A function that starts a camera by its answer, and returns its host and port."""
    with contextlib.ExitStack() as stack:
        yield lambda answer: stack.enter_context(contextlib.closing(Server(answer))).address


@pytest.fixture
def start_sending():
    """A function that sends RTP by `send`, until the end of the test, and returns the port."""
    is_on = threading.Event()
    is_on.set()

    def start(send):
        port = free_port()
        threading.Thread(target=send, args=(port, is_on), daemon=True).start()
        return port

    yield start
    is_on.clear()


def find_cause(uri):
    with pytest.raises(OpeningError) as refusal:
        streams.open_address(uri, lambda: 0.0, 0.5)
    return str(refusal.value)


BASIC = 'WWW-Authenticate: Basic realm="camera"'


def hang(connection, asked):
    asked.read()


@pytest.mark.parametrize(
    ("address", "answer", "cause"),
    [
        ("rtsp://", answer_rtsp("401 Unauthorized", header=BASIC), "password needed (401): add USER:PASSWORD@"),
        (f"rtsp://pilot:{PASSWORD}@", answer_rtsp("401 Unauthorized", header=BASIC), "password refused (401)"),
        ("rtsp://", answer_rtsp("403 Forbidden"), "(403)"),
        ("rtsp://", answer_rtsp("404 Not Found"), "(404)"),
        ("rtsp://", answer_rtsp("453 Not Enough Bandwidth"), "(453)"),
        ("rtsp://", answer_rtsp("503 Service Unavailable"), "(503)"),
        ("rtsp://", answer_rtsp("461 Unsupported Transport", refuses="SETUP"), "(461)"),
        ("rtsp://", lambda connection, asked: asked.readline(), "connection closed"),
        ("rtsp://", hang, "0.7 s"),
        ("http://", answer_http("401 Unauthorized"), "password needed (401)"),
        ("http://", answer_http("403 Forbidden"), "(403)"),
        ("http://", answer_http("404 Not Found"), "(404)"),
        ("http://", answer_http("500 Internal Server Error"), "(500)"),
        ("http://", answer_http("200 OK", "text/html", b"<html>log in</html>"), "only text/html"),
        ("http://", hang, "0.7 s"),
    ],
)
def test_open_address_names_the_cause(address, answer, cause, serve, monkeypatch):
    if "0.7 s" in cause:
        monkeypatch.setattr(streams, "OPEN_TIMEOUT_S", 0.7)
    found = find_cause(f"{address}{serve(answer)}/stream")
    assert cause in found
    assert PASSWORD not in found


def test_open_address_names_the_cause_without_a_camera(monkeypatch):
    closed = free_port()
    for uri in (f"rtsp://127.0.0.1:{closed}/a", f"http://127.0.0.1:{closed}/a", f"tcp://127.0.0.1:{closed}"):
        assert find_cause(uri) == "connection refused"
    for uri in ("udp://:99999", "rtsp://127.0.0.1:99999/a"):
        assert {"host", "port"} <= set(find_cause(uri).split())
    assert "camera.invalid" in find_cause("rtsp://camera.invalid/a")
    assert "percent-encode" in find_cause("rtsp://pilot:a@b/secret@10.0.0.1/a")
    monkeypatch.setattr(streams, "OPEN_TIMEOUT_S", 0.3)
    cause = find_cause(f"udp://:{closed}")
    assert (f"UDP port {closed} " in cause, "0.3 s" in cause) == (True, True)


@pytest.mark.parametrize("password", ["sec/ret", "sec#ret", "sec?ret", "sec ret"])
def test_open_source_refuses_a_password_that_must_be_percent_encoded(password):
    with pytest.raises(SourceError, match="percent-encoded") as refusal:
        open_source(f"rtsp://pilot:{password}@127.0.0.1:9/camera", live=True)
    assert password not in str(refusal.value)


@pytest.mark.parametrize(
    "uri", ["http://127.0.0.1:9/photo@2x.jpg", "rtsp://u:p@127.0.0.1:9/a?b=c@d", "http://[::1]:9/a@b", "rtsp://h/a:b@c"]
)
def test_open_source_finds_no_password_in_a_path_with_an_at_sign(uri, open_live_source):
    assert open_live_source(uri).is_live


def test_open_address_decodes_a_percent_encoded_password(serve):
    right = "Basic " + base64.b64encode(b"pilot:geh#heim").decode()
    address = serve(answer_rtsp("401 Unauthorized", header=BASIC, authorization=right))
    stream = streams.open_address(f"rtsp://pilot:{PASSWORD}@{address}/stream", lambda: 0.0, 0.5)
    assert stream.facts.codec == "h264"
    stream.release()


@pytest.mark.parametrize(("path", "cause"), [("/dev/null", "not a V4L2 camera"), ("/dev/video97", "not connected")])
def test_open_device_names_the_cause(path, cause):
    with pytest.raises(OpeningError) as refusal:
        open_device(path, lambda: 0.0)
    assert str(refusal.value) == cause


def read_first_frame(source):
    frame = wait_until(lambda: source.read(0.05))
    assert frame.image.shape == (HEIGHT, WIDTH, 3)
    assert frame.image.std() > 5
    return frame


@pytest.mark.slow
@pytest.mark.parametrize("over_tcp", ["461", "offer"])
def test_rtsp_falls_back_to_udp(over_tcp, open_live_source, serve):
    source = open_live_source(f"rtsp://{serve(answer_rtsp(refuses='', over_tcp=over_tcp))}/stream")
    read_first_frame(source)
    assert (source.facts.codec, source.facts.bits, source.facts.pixel_aspect) == ("h264", 8, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "send", "codec"),
    [
        ("udp", send_rtp, "h264"),
        ("rtp", send_rtp, "h264"),
        ("udp", lambda *where: send_rtp(*where, "libx265"), "hevc"),
        ("udp", lambda *where: send_rtp(*where, "mjpeg"), "mjpeg"),
    ],
)
def test_rtp_at_a_udp_port_is_read_without_a_description(scheme, send, codec, open_live_source, start_sending):
    source = open_live_source(f"{scheme}://127.0.0.1:{start_sending(send)}")
    read_first_frame(source)
    assert source.facts.codec == codec


def test_open_address_names_ports_in_use(start_sending):
    port = start_sending(send_rtp)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", port + 1))
        cause = find_cause(f"udp://:{port}")
        assert (f"UDP port {port + 1} " in cause, "in use" in cause) == (True, True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", port))
        cause = find_cause(f"udp://:{port}")
        assert (f"UDP port {port} " in cause, "in use" in cause) == (True, True)


def send_unknown(port, is_on):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while is_on.is_set():
            sender.sendto(b"\x80\x62" + bytes(10) + b"\xff\xff picture", ("127.0.0.1", port))
            time.sleep(0.01)


def test_rtp_of_an_unknown_codec_asks_for_a_description(start_sending):
    cause = find_cause(f"udp://:{start_sending(send_unknown)}")
    assert ("98" in cause, ".sdp" in cause) == (True, True)


@pytest.mark.parametrize("has_length", [True, False])
@pytest.mark.parametrize(("kind", "extension"), [("image/jpg", ".jpg"), ("image/png", ".png")])
def test_multipart_stream_accepts_any_image_type(kind, extension, has_length, open_live_source, serve):
    source = open_live_source(f"http://{serve(answer_multipart(kind, extension, has_length))}/video")
    numbers = [int(read_first_frame(source).name.split()[1]) for _ in range(3)]
    assert numbers == sorted(set(numbers))


def test_multipart_stream_without_lengths_does_not_wait_for_the_next_part(open_live_source, serve):
    """FFmpeg gives such a picture when the next one has come, as if it had been taken then."""
    connections: list[list[float]] = []
    source = open_live_source(f"http://{serve(answer_multipart(has_length=False, connections=connections))}/video")
    late_s = []
    for _ in range(12):
        frame = read_first_frame(source)
        sent_s = connections[-1]  # the first was FFmpeg's
        (number,) = (at for at in range(len(sent_s)) if abs(frame.image.astype(int) - draw_picture(at)).mean() < 4)
        late_s.append(frame.t_mono_s - sent_s[number])
    assert median(late_s) < 0.7 / RATE_HZ


def test_connection_of_a_multipart_stream_is_closed_with_the_capture(serve):
    """Some cameras serve one viewer at a time."""
    is_closed, send = threading.Event(), answer_multipart()

    def answer(connection, asked):
        try:
            send(connection, asked)
        except OSError:
            is_closed.set()

    capture = streams.open_address(f"http://{serve(answer)}/video", time.monotonic, 0.1)
    capture.read()
    capture.release()
    assert is_closed.wait(PATIENCE_S)


def test_snapshots_are_requested_repeatedly_and_aged_from_the_request(serve):
    asked_s: list[float] = []

    def take_snapshot(number):
        asked_s.append(time.monotonic())
        time.sleep(0.05)
        return encode_image(number)

    address = serve(answer_http("200 OK", "image/jpeg", take_snapshot))
    capture = streams.open_address(f"http://{address}/snapshot.jpg", time.monotonic, 0.1)
    first, second = capture.read(), capture.read()
    assert not (first.convert() == second.convert()).all()
    assert first.convert().shape == (HEIGHT, WIDTH, 3)
    assert asked_s[-3] < first.t_mono_s <= asked_s[-2]
    assert first.t_mono_s + 0.1 <= second.t_mono_s <= asked_s[-1]


def test_snapshots_cached_by_the_camera_are_aged_from_the_previous_request(serve):
    address = serve(answer_http("200 OK", "image/jpeg", lambda number: encode_image(number // 2)))
    capture = streams.open_address(f"http://{address}/snapshot.jpg", time.monotonic, 0.1)
    *_, last = (capture.read() for _ in range(4))
    assert time.monotonic() - last.t_mono_s > 0.1


def test_snapshots_truncated_are_damaged_and_failed_ones_lost(open_live_source, serve):
    pictures = iter([encode_image(0), encode_image(1), encode_image(2)[:900], b""])
    server = Server(answer_http("200 OK", "image/jpeg", lambda number: next(pictures)))
    source = open_live_source(f"http://{server.address}/snapshot.jpg")
    wait_until(lambda: source.refused["damaged"] >= 1)
    server.close()
    wait_until(lambda: source.condition is Condition.LOST)


def test_snapshots_accept_a_password(serve):
    right = "Basic " + base64.b64encode(b"pilot:geh#heim").decode()

    def answer(connection, asked):
        _, headers = read_request(asked)
        is_right = headers.get("authorization") == right
        picture, status = (encode_image(0), "200 OK") if is_right else (b"", f"401 Unauthorized\r\n{BASIC}")
        head = f"HTTP/1.0 {status}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
        connection.sendall(head.encode() + picture)

    capture = streams.open_address(f"http://pilot:{PASSWORD}@{serve(answer)}/snapshot.jpg", lambda: 0.0, 0.5)
    assert isinstance(capture.read(), Shot)


def check_source(uri):
    finding = camera.check_frame("source", load_config(None, {"source.uri": uri}).source)
    return finding.reason.code, finding.reason.parameters


def test_check_frame_has_the_facts_of_the_first_picture_and_refuses_an_old_one(serve, monkeypatch):
    uri = f"http://{serve(answer_multipart('image/jpg', '.jpg'))}/video"
    code, found = check_source(uri)
    assert (code, found["width"], found["height"]) == (FindingCode.FRAME_RECEIVED, WIDTH, HEIGHT)
    assert [fact.split()[0] for fact in found["facts"].split(", ")] == ["mjpeg", "8", "square"]
    monkeypatch.setattr(camera, "MAX_FIX_AGE_S", -1.0)
    assert check_source(uri)[0] is FindingCode.FRAMES_LATE
