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


def packet(attributes="", elements=""):
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {NAMESPACES} {attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>'
    ).encode()


@pytest.fixture
def read(tmp_path):
    """Read a packet from the place where cameras put it, in a segment before the picture."""

    def of(content):
        jpeg = photographs.encoded(".jpg", photographs.picture())
        payload = b"http://ns.adobe.com/xap/1.0/\x00" + content
        path = tmp_path / "photo.jpg"
        path.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload + jpeg[2:])
        return read_xmp(path)

    return of


def down(heading_deg, height_m):
    """What is read of a camera that looks straight down."""
    zero = pytest.approx(0, abs=1e-9)
    return GeoTag(heading_deg=pytest.approx(heading_deg), roll_deg=zero, pitch_deg=zero, height_m=height_m)


def gimbal(yaw, pitch, roll, maker="drone-dji:Gimbal"):
    return f'{maker}YawDegree="{yaw}" {maker}PitchDegree="{pitch}" {maker}RollDegree="{roll}"'


def test_a_photograph_of_dji(read, tmp_path):
    attributes = 'drone-dji:RelativeAltitude="+40.10" drone-dji:FlightYawDegree="+10.0" ' + gimbal("-30.0", "-80.0", 0)
    found = read(packet(attributes))
    assert found == GeoTag(
        heading_deg=pytest.approx(330), roll_deg=pytest.approx(0), pitch_deg=pytest.approx(10), height_m=40.1
    )
    assert read_exif(tmp_path / "photo.jpg") == GeoTag(
        heading_deg=found.heading_deg, roll_deg=found.roll_deg, pitch_deg=found.pitch_deg, height_m=40.1
    )


SKYDIO = {
    "attributes": '<drone-skydio:CameraOrientationNED drone-skydio:Pitch="-90" drone-skydio:Roll="0" '
    'drone-skydio:Yaw="75"/>',
    "elements": '<drone-skydio:CameraOrientationNED rdf:parseType="Resource"><drone-skydio:Roll>0</drone-skydio:Roll>'
    "<drone-skydio:Pitch>-90</drone-skydio:Pitch><drone-skydio:Yaw>75</drone-skydio:Yaw>"
    "</drone-skydio:CameraOrientationNED>",
}
BODY = '<drone-skydio:CameraOrientationFLU drone-skydio:Pitch="1" drone-skydio:Roll="2" drone-skydio:Yaw="3"/>'


@pytest.mark.parametrize("form", SKYDIO)
def test_of_the_orientations_of_skydio_that_against_north_and_down_counts(read, form):
    found = read(packet('drone-skydio:RelativeAltitude="42.5"', BODY + SKYDIO[form] + BODY))
    assert found == down(75, 42.5)


def test_autel_writes_what_dji_writes_under_another_name(read):
    found = read(packet('drone:RelativeAltitude="51.2" ' + gimbal(75, -90, 0, "drone:Gimbal")))
    assert found == down(75, 51.2)
    assert read(packet('drone:FlightYawDegree="-60"')).heading_deg == 300


@pytest.mark.parametrize(
    ("told", "meant"),
    [
        ((120, -90, 0), (120, 0, 0)),
        ((-60, -90, 180), (120, 0, 0)),  # half a turn of the roll is half a turn of the picture
        ((100, -90, 20), (120, 0, 0)),
        ((30, -0.5, 0), (30, 0, 89.5)),  # it looks ahead
    ],
)
def test_a_gimbal_that_looks_down_turns_by_its_roll(read, told, meant):
    found = read(packet(gimbal(*told)))
    assert (found.heading_deg, found.roll_deg, found.pitch_deg) == pytest.approx(meant, abs=1e-6)


def test_a_gimbal_of_zeros_tells_nothing_and_nose_and_height_count(read):
    """A small DJI drone writes so of a camera that looks straight down."""
    nose = 'drone-dji:RelativeAltitude="+39.80" drone-dji:FlightYawDegree="-60.5" drone-dji:FlightPitchDegree="-3.1" '
    assert read(packet(nose + gimbal("+0.00", "+0.00", "+0.00"))) == GeoTag(heading_deg=299.5, height_m=39.8)


def test_a_gimbal_tilted_to_its_side_is_the_same_told_either_way(read):
    """It looks east and 20 degrees up from straight down, and a roll by -90 turns the top of its picture to north: that
    is a camera that leans to the left."""
    found = read(packet(gimbal(90, -70, -90)))
    assert (found.roll_deg, found.pitch_deg) == pytest.approx((-20, 0), abs=1e-6)
    assert math.remainder(found.heading_deg, 360) == pytest.approx(0, abs=1e-6)


def test_parrot_writes_elements(read):
    values = {"Yaw": 176.3, "Pitch": -78.4, "Roll": -0.3}
    elements = "".join(
        f"<drone-parrot:Camera{axis}Degree>{value}</drone-parrot:Camera{axis}Degree>" for axis, value in values.items()
    )
    found = read(packet(elements=elements))
    assert found.pitch_deg == pytest.approx(11.6, abs=0.01)
    assert found.height_m is None


def test_of_the_tags_of_pix4d_zero_is_straight_down(read):
    told = read(packet('Camera:Yaw="-10" Camera:Pitch="4.5" Camera:Roll="-3"'))
    assert told == GeoTag(heading_deg=350.0, roll_deg=-3.0, pitch_deg=4.5)
    assert read(packet('Camera:Yaw="0" Camera:Pitch="0" Camera:Roll="0"')) == GeoTag(), "a camera without an IMU"


def test_without_a_gimbal_the_nose_tells_the_heading_only(read):
    attributes = 'drone-dji:FlightYawDegree="-90" drone-dji:FlightRollDegree="5" drone-dji:FlightPitchDegree="5"'
    assert read(packet(attributes)) == GeoTag(heading_deg=270.0)


@pytest.mark.parametrize("value", ["nan", "-1e9", "361", "", "0/100", "north", "+-"])
def test_a_senseless_value_is_unknown(read, value):
    assert read(packet(gimbal(10, value, 0))) == GeoTag()
    assert read(packet(f'drone-dji:RelativeAltitude="{value}"')).height_m in (None, 361.0)


def test_only_numbers_of_the_first_packet_near_the_beginning_are_read(read, tmp_path):
    told = packet('drone-dji:RelativeAltitude="40"')
    assert read(told + packet('drone-dji:RelativeAltitude="50"')).height_m == 40.0
    assert read(b'<!DOCTYPE x [<!ENTITY j "40">]>' + told.replace(b"40", b"&j;")) == GeoTag()
    path = tmp_path / "p.jpg"
    path.write_bytes(bytes(400_000) + told)
    assert read_xmp(path) == read_xmp(tmp_path) == read_xmp(tmp_path / "missing.jpg") == GeoTag()
