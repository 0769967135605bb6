"""The object detector for the staticity criterion, and its card. Its file is not part of edgevpr: it must be in the
folder $EDGEVPR_DETECTORS (default: ../shared/models beside the project)."""

import json
import os
from pathlib import Path

from edgevpr.techniques.session import hash_model_file

NAME = "yolox_nano"
FOLDER = Path(os.environ.get("EDGEVPR_DETECTORS") or Path(__file__).resolve().parents[2] / "shared" / "models")
FILE = FOLDER / NAME / "model.onnx"
# The COCO classes that move (thesis 3.2.2), with their numbers.
_DYNAMIC = {
    "person": 0, "bicycle": 1, "car": 2, "motorcycle": 3, "aeroplane": 4, "bus": 5, "train": 6, "truck": 7, "boat": 8,
    "bird": 14, "cat": 15, "dog": 16, "horse": 17, "sheep": 18, "cow": 19, "elephant": 20, "bear": 21, "zebra": 22,
    "giraffe": 23, "backpack": 24, "umbrella": 25,
}  # fmt: skip
_INPUT = {"layout": "NCHW", "colour": "bgr", "equalise": False, "resize": "linear", "mean": [0.0]}
_CARD = {
    "input": {**_INPUT, "height": 416, "width": 416, "scale": 1.0, "pad": 114},
    "outputs": {"boxes": ["output"]},
    "detector": {"family": "yolox", "min_score": 0.3, "dynamic": _DYNAMIC},
}


def install_detector(folder: Path) -> None:
    """Link the detector into a folder of models, and write its card there."""
    (folder / f"{NAME}.onnx").symlink_to(FILE.resolve())
    card = {
        "title": NAME,
        "file": f"{NAME}.onnx",
        "sha256": hash_model_file(FILE),
        "licence": "see the file's own",
        "source": "an ONNX file beside the project",
        **_CARD,
    }
    (folder / f"{NAME}.yaml").write_text(json.dumps(card))
