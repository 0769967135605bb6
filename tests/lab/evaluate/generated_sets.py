"""Small sets of generated pictures for the tests of evaluations."""

import cv2
from pictures import draw_texture


def make_set(folder, places=6):
    """Each query is its place, darker; one is not scored, one place is ignored, the last query is off the map."""
    rows = ["query_file,ref_files,ref_files_loose,status"]
    for part in ("query", "ref"):
        (folder / part).mkdir(parents=True)
    for place in range(places):
        picture = draw_texture(place)
        cv2.imwrite(str(folder / "query" / f"q{place}.png"), picture // 2)
        right, loose, status = f"r{place}.png", "", "ok"
        if place == places - 1:
            picture, right, status = draw_texture(1000), "", "novel"
        elif place == 1:  # its own place counts neither way
            right, loose = "r0.png", "r1.png"
        elif place == 2:
            status = "unsure"
        cv2.imwrite(str(folder / "ref" / f"r{place}.png"), picture)
        rows.append(f"q{place}.png,{right},{loose},{status}")
    (folder / "ground_truth.csv").write_text("\n".join(rows) + "\n")
    return folder
