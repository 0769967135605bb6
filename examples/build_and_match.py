"""Make a map of a folder of pictures, and find others in it: python build_and_match.py MAPPED LATER [FILE.geojson]"""

import json
import sys
from pathlib import Path

import cv2

import edgevpr


def main(mapped: str, later: str, out: str = "matches.geojson") -> None:
    path = Path(out).with_suffix(".gpkg")
    if not path.exists():
        made = edgevpr.build(path, mapped, camera="nadir")
        print(f"{path}: {made.places} places")
    features = []
    with edgevpr.Map(path) as ground:
        for picture in sorted(Path(later).glob("*.jpg")):
            match = ground.match(cv2.imread(str(picture)))
            features.append(match.geojson())
            where = f"{match.position.lat_deg:.6f} {match.position.lon_deg:.6f}" if match.position else match.reason
            print(f"{picture.name}  {where}")
    Path(out).write_text(json.dumps({"type": "FeatureCollection", "features": features}))


if __name__ == "__main__":
    main(*sys.argv[1:])
