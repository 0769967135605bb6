"""Small sets of generated pictures for the tests of many sets and rows."""

import cv2
from pictures import textured

HOG = {"w1": 64}
COHOG = {"w1": 208}


def make_set(folder, places=6, first=0):
    """Each query is its place, darker; the truth of the last is wrong on purpose, one is loose, and one not scored."""
    rows = ["query_file,ref_files,ref_files_loose,status"]
    for part in ("query", "ref"):
        (folder / part).mkdir(parents=True)
    for place in range(places):
        picture = textured(first + place)
        cv2.imwrite(str(folder / "ref" / f"r{place}.png"), picture)
        cv2.imwrite(str(folder / "query" / f"q{place}.png"), picture // 2)
        right, loose, status = f"r{place}.png", "", "ok"
        if place == places - 1:
            right = "r0.png"
        elif place == 1:  # its own place counts neither way
            right, loose = "r0.png", "r1.png"
        elif place == 2:
            status = "unsure"
        rows.append(f"q{place}.png,{right},{loose},{status}")
    (folder / "ground_truth.csv").write_text("\n".join(rows) + "\n")
    return folder


def without_costs(content):
    """Results as JSON, without what differs from run to run."""
    kept = []
    for row in content["results"]:
        times = ("t_", "u_", "ah_", "pcu", "made")
        kept.append({key: value for key, value in row.items() if not key.startswith(times)})
    return kept
