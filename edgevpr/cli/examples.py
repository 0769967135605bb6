"""Examples of each command, as its help shows them: what it is for, and what to type."""

from collections.abc import Mapping

EXAMPLES: Mapping[str, tuple[tuple[str, str], ...]] = {
    "positions": (
        ("the subtitles beside a video of DJI", "DJI_0001.SRT --images DJI_0001.MP4"),
        ("photographs by the log of the autopilot", "00000042.BIN --images photos/"),
        ("a camera whose clock is 3.5 s slow", "track.gpx --images photos/ --offset-s 3.5"),
    ),
    "map build": (
        ("photographs that look straight down", "valley.gpkg --images photos/ --camera nadir"),
        ("a video, a place each second", "road.gpkg --images flight.mp4 --rate-hz 1"),
        (
            "a satellite image, for a camera that shows 120 m",
            "town.gpkg --orthophoto town.tif --footprint-m 120 --spacing-m 30",
        ),
    ),
    "map refine": (("after a merge", "valley.gpkg --images photos/"),),
    "map move": (("by the GPS of a flight with this map", "valley.gpkg --by flight.jsonl"),),
    "map calibrate": (("after a merge", "valley.gpkg --images photos/"),),
    "map info": (
        ("what is in it", "valley.gpkg"),
        ("a page of it, with the ground", "valley.gpkg --page valley.html --map-images photos/"),
    ),
    "map check": (("before a flight", "valley.gpkg"),),
    "map repair": (("after `map check` has named damage", "valley.gpkg"),),
    "map merge": (("two flights as one map", "all.gpkg monday.gpkg tuesday.gpkg"),),
    "map subset": (
        ("the part of a folder of maps that a mission needs", "valley/ --mission plan.waypoints --out flight.gpkg"),
        ("the same in at most 50 MB", "valley/ --mission plan.plan --margin-m 300 --mb 50 --out flight.gpkg"),
        ("the best places of a map in 5 MB", "valley.gpkg --mission 47.39,8.54,9000 --mb 5 --out small.gpkg"),
    ),
    "salience": (("how memorable an image is", "photos/0042.jpg"),),
    "match": (
        ("where later pictures were taken", "valley.gpkg --images later/"),
        ("with the heading and height that a flight knows", "valley.gpkg --images later/ --known heading,height"),
    ),
    "run": (
        (
            "a flight that sends nothing yet",
            "--map valley.gpkg --source /dev/video0 --link udpin:0.0.0.0:14550 --dry-run",
        ),
        ("by a configuration file", "--config flight.yaml"),
    ),
    "check": (("whether that flight can start", "--config flight.yaml"),),
    "service print": (("the unit, with the limits of a board", "--board rpi-zero-2w"),),
    "doctor": (("what is wrong with autopilot and board", "--link serial:/dev/ttyAMA0:921600"),),
    "top": (("watch the flight of the service", ""),),
    "report": (("a page of a flight", "flight.jsonl --out report.html --images later/ --map-images photos/"),),
    "replay": (("replay it, and compare each line", "flight.jsonl --map valley.gpkg"),),
    "profile": (
        ("a map on a board", "--map valley.gpkg --board rpi-4b --battery 4S5200 --flight-min 20"),
        ("every technique on a small board", "--places 10000 --board rpi-zero-2w --camera nadir"),
    ),
    "eval": (("techniques on a data set", "--data my_set/ --techniques cohog,hog --camera nadir"),),
    "simulate flight": (
        ("a generated mapping flight", "mapping"),
        ("a later one over the same ground", "later --which query"),
        ("a mission over this year's ground", "later --orthophoto now.tif --track mission.plan --height-m 120"),
    ),
    "demo": (("the whole job in a minute", "--out demo_out"),),
}


def format_examples(command: str) -> str:
    """Return the examples of a command, such as `map build`, as text below its help."""
    lines = [f"  # {text}\n  edgevpr {command} {rest}".rstrip() for text, rest in EXAMPLES[command]]
    return "\n".join(["examples:", *lines])
