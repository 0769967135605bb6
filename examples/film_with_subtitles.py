"""A film with the subtitles that a DJI drone writes, of a generated flight: python film_with_subtitles.py FLIGHT OUT

FLIGHT is a folder of `edgevpr simulate flight`; OUT.MP4 and OUT.SRT are written. One picture is a second of the film.
"""

import csv
import sys
from fractions import Fraction
from pathlib import Path

import av


def main(flight: str, out: str) -> None:
    with open(Path(flight) / "positions.csv", newline="") as table:
        rows = list(csv.DictReader(table))
    with av.open(f"{out}.MP4", "w") as film:
        stream = film.add_stream("h264", rate=1, options={"crf": "20"})
        for number, row in enumerate(rows):
            with av.open(str(Path(flight) / "images" / row["file"])) as picture:
                frame = next(picture.decode(video=0)).reformat(format="yuv420p")
            if number == 0:
                stream.width, stream.height = frame.width, frame.height
            frame.pts, frame.time_base = number, Fraction(1)
            film.mux(stream.encode(frame))
        film.mux(stream.encode(None))
    with open(f"{out}.SRT", "w") as subtitles:
        for number, row in enumerate(rows):
            begins, ends = (f"{t // 3600:02d}:{t // 60 % 60:02d}:{t % 60:02d},000" for t in (number, number + 1))
            subtitles.write(f"{number + 1}\n{begins} --> {ends}\n[latitude: {row['lat']}] [longitude: {row['lon']}] ")
            subtitles.write(f"[rel_alt: {row['height_m']} abs_alt: {row['alt']}]\n\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
