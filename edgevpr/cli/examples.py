"""Examples for the help of each command: what each example does, and what to type."""

from collections.abc import Mapping

EXAMPLES: Mapping[str, tuple[tuple[str, str], ...]] = {
    "positions": (
        ("a DJI video, from its subtitles", "DJI_0001.SRT --images DJI_0001.MP4"),
        ("photographs, from the autopilot's log", "00000042.BIN --images photos/"),
        ("a camera whose clock is 3.5 s slow", "track.gpx --images photos/ --offset-s 3.5"),
    ),
    "map build": (
        ("from photographs taken straight down", "valley.gpkg --images photos/ --camera nadir"),
        ("from a video, one place per second", "road.gpkg --images flight.mp4 --rate-hz 1"),
        (
            "from a satellite image, for a camera with a footprint of 120 m",
            "town.gpkg --orthophoto town.tif --footprint-m 120 --spacing-m 30",
        ),
    ),
    "map refine": (("after a merge", "valley.gpkg --images photos/"),),
    "map move": (("by the offset that a flight with this map measured", "valley.gpkg --by flight.jsonl"),),
    "map calibrate": (("after a merge", "valley.gpkg --images photos/"),),
    "map info": (
        ("print what the map contains", "valley.gpkg"),
        ("write a page with its images", "valley.gpkg --page valley.html --map-images photos/"),
    ),
    "map check": (("before a flight", "valley.gpkg"),),
    "map repair": (("after `map check` has found damage", "valley.gpkg"),),
    "map merge": (("the maps of two flights", "all.gpkg monday.gpkg tuesday.gpkg"),),
    "map subset": (
        ("the part of a folder of maps that a mission needs", "valley/ --mission plan.waypoints --out flight.gpkg"),
        ("the same in at most 50 MB", "valley/ --mission plan.plan --margin-m 300 --mb 50 --out flight.gpkg"),
        ("the best places of a map in 5 MB", "valley.gpkg --mission 47.39,8.54,9000 --mb 5 --out small.gpkg"),
    ),
    "salience": (("how memorable an image is", "photos/0042.jpg"),),
    "match": (
        ("find where later images were taken", "valley.gpkg --images later/"),
        ("with heading and height known, as in flight", "valley.gpkg --images later/ --known heading,height"),
    ),
    "run": (
        (
            "a dry run, which sends no positions",
            "--map valley.gpkg --source /dev/video0 --link udpin:0.0.0.0:14550 --dry-run",
        ),
        ("with a configuration file", "--config flight.yaml"),
    ),
    "check": (("check whether a flight can start", "--config flight.yaml"),),
    "service print": (("the unit with the limits of a board", "--board rpi-zero-2w"),),
    "doctor": (("check the autopilot and this computer", "--link serial:/dev/ttyAMA0:921600"),),
    "top": (("watch the flight of the service", ""),),
    "report": (("a page with images", "flight.jsonl --out report.html --images later/ --map-images photos/"),),
    "replay": (("replay the last flight of a log", "flight.jsonl --map valley.gpkg"),),
    "profile": (
        ("one map on a board", "--map valley.gpkg --board rpi-4b --battery 4S5200 --flight-min 20"),
        ("every technique on a small board", "--places 10000 --board rpi-zero-2w --camera nadir"),
    ),
    "eval": (("compare techniques on a data set", "--data my_set/ --techniques cohog,hog --camera nadir"),),
    "simulate flight": (
        ("a generated mapping flight", "mapping"),
        ("a later flight over the same ground", "later --which query"),
        ("a mission over an orthophoto", "later --orthophoto now.tif --track mission.plan --height-m 120"),
    ),
    "demo": (("from map to matches in a minute", "--out demo_out"),),
}


def format_examples(command: str) -> str:
    """Return the examples for a command, such as `map build`, as the text below its help."""
    lines = [f"  # {text}\n  edgevpr {command} {arguments}".rstrip() for text, arguments in EXAMPLES[command]]
    return "\n".join(["examples:", *lines])
