"""Attitude and height from the XMP of drones, right, wrong and hostile."""

import math

import photographs
import pytest

from edgevpr.frames.exif import read_exif, read_xmp
from edgevpr.frames.positions import GeoTag

NAMESPACES = (
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:Camera="http://pix4d.com/camera/1.0/" '
    'xmlns:drone-parrot="http://www.parrot.com/drone-parrot/1.0/"'
)


def make_packet(attributes="", elements=""):
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {NAMESPACES} {attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>'
    ).encode()


@pytest.fixture
def read(tmp_path):
    """Read a packet from the place where cameras put it, in a segment before the picture."""

    def read_packet(content):
        jpeg = photographs.encode_image(".jpg", photographs.draw_picture())
        path = tmp_path / "photo.jpg"
        path.write_bytes(photographs.insert_app1(jpeg, content, b"http://ns.adobe.com/xap/1.0/\x00"))
        return read_xmp(path)

    return read_packet


def format_gimbal(yaw, pitch, roll, maker="drone-dji:Gimbal"):
    return f'{maker}YawDegree="{yaw}" {maker}PitchDegree="{pitch}" {maker}RollDegree="{roll}"'


DJI_FLIGHT = 'drone-dji:RelativeAltitude="+40.10" drone-dji:FlightYawDegree="+10.0" '
DJI = make_packet(DJI_FLIGHT + format_gimbal("-30.0", "-80.0", 0))
AUTEL = make_packet('drone:RelativeAltitude="51.2" ' + format_gimbal(75, -90, 0, "drone:Gimbal"))
SKYDIO_ATTRIBUTES = (
    '<drone-skydio:CameraOrientationNED drone-skydio:Pitch="-90" drone-skydio:Roll="0" drone-skydio:Yaw="75"/>'
)
SKYDIO_ELEMENTS = (
    '<drone-skydio:CameraOrientationNED rdf:parseType="Resource"><drone-skydio:Roll>0</drone-skydio:Roll>'
    "<drone-skydio:Pitch>-90</drone-skydio:Pitch><drone-skydio:Yaw>75</drone-skydio:Yaw>"
    "</drone-skydio:CameraOrientationNED>"
)
SKYDIO_BODY = '<drone-skydio:CameraOrientationFLU drone-skydio:Pitch="1" drone-skydio:Roll="2" drone-skydio:Yaw="3"/>'
SKYDIO_HEIGHT = 'drone-skydio:RelativeAltitude="42.5"'
PARROT = "".join(
    f"<drone-parrot:Camera{axis}Degree>{value}</drone-parrot:Camera{axis}Degree>"
    for axis, value in {"Yaw": 176.3, "Pitch": -78.4, "Roll": 0}.items()
)
# A small DJI drone writes zeros of a camera that looks straight down: they tell nothing, nose and height count.
NOSE = 'drone-dji:RelativeAltitude="+39.80" drone-dji:FlightYawDegree="-60.5" drone-dji:FlightPitchDegree="-3.1" '


@pytest.mark.parametrize(
    ("content", "heading_deg", "roll_deg", "pitch_deg", "height_m"),
    [
        (DJI, 330, 0, 10, 40.1),
        (AUTEL, 75, 0, 0, 51.2),
        (make_packet('drone:FlightYawDegree="-60"'), 300, None, None, None),
        (make_packet(SKYDIO_HEIGHT, SKYDIO_BODY + SKYDIO_ATTRIBUTES + SKYDIO_BODY), 75, 0, 0, 42.5),
        (make_packet(SKYDIO_HEIGHT, SKYDIO_BODY + SKYDIO_ELEMENTS + SKYDIO_BODY), 75, 0, 0, 42.5),
        (make_packet(elements=PARROT), 176.3, 0, 11.6, None),
        (make_packet('Camera:Yaw="-10" Camera:Pitch="4.5" Camera:Roll="-3"'), 350, -3, 4.5, None),  # Pix4D: 0 is down
        (make_packet('Camera:Yaw="0" Camera:Pitch="0" Camera:Roll="0"'), None, None, None, None),  # no IMU
        (make_packet(NOSE + format_gimbal("+0.00", "+0.00", "+0.00")), 299.5, None, None, 39.8),
        # A roll by half a turn rotates the picture by half a turn.
        (make_packet(format_gimbal(-60, -90, 180)), 120, 0, 0, None),
        (make_packet(format_gimbal(100, -90, 20)), 120, 0, 0, None),
        (make_packet(format_gimbal(30, -0.5, 0)), 30, 0, 89.5, None),  # it looks ahead
    ],
)
def test_read_xmp_of_each_maker(read, content, heading_deg, roll_deg, pitch_deg, height_m, tmp_path):
    found = read(content)
    expected = (heading_deg, roll_deg, pitch_deg, height_m)
    values = found.heading_deg, found.roll_deg, found.pitch_deg, found.height_m
    for value, wanted in zip(values, expected, strict=True):
        assert value == (wanted if wanted is None else pytest.approx(wanted, abs=1e-6))
    assert read_exif(tmp_path / "photo.jpg") == found


def test_read_xmp_of_a_gimbal_tilted_to_its_side(read):
    """It looks east and 20 degrees up from straight down, and a roll by -90 turns the top of its picture to north: that
    is a camera that leans to the left."""
    found = read(make_packet(format_gimbal(90, -70, -90)))
    assert (found.roll_deg, found.pitch_deg) == pytest.approx((-20, 0), abs=1e-6)
    assert math.remainder(found.heading_deg, 360) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("value", ["nan", "-1e9", "361", "", "0/100", "north", "+-"])
def test_read_xmp_treats_an_implausible_value_as_unknown(read, value):
    assert read(make_packet(format_gimbal(10, value, 0))) == GeoTag()
    assert read(make_packet(f'drone-dji:RelativeAltitude="{value}"')).height_m in (None, 361.0)


def test_read_xmp_reads_only_numbers_of_the_first_packet_near_the_beginning(read, tmp_path):
    first = make_packet('drone-dji:RelativeAltitude="40"')
    assert read(first + make_packet('drone-dji:RelativeAltitude="50"')).height_m == 40.0
    assert read(b'<!DOCTYPE x [<!ENTITY j "40">]>' + first.replace(b"40", b"&j;")) == GeoTag()
    path = tmp_path / "p.jpg"
    path.write_bytes(bytes(400_000) + first)
    assert read_xmp(path) == read_xmp(tmp_path) == read_xmp(tmp_path / "missing.jpg") == GeoTag()
