"""One way on one data set, in a process of its own, so that its memory is its own: prints JSON.

python -m peers.one WAY CAMERA SET [TRAINING ...]
"""

import json
import resource
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

_QUALITY = "recall", "precision_at", "auc", "ep", "roc", "queries", "references"
STARTED_MB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def ours(camera: str, folder: Path) -> dict[str, Any]:
    """Measure edgevpr's own, as it flies."""
    begin_s = time.process_time()
    import cv2

    from edgevpr.evaluate.dataset import load_dataset
    from edgevpr.evaluate.evaluate import evaluate

    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    result = asdict(evaluate("cohog", dataset, {"camera": camera}))
    return {
        "set": folder.name,
        "quality": {key: value for key, value in result.items() if key.startswith(_QUALITY)},
        "t_encode_ms": 1e3 * result["t_encode_s"],
        "t_match_ms": 1e3 * result["t_match_s"],
        "bytes": result["descriptor_bytes"],
        "ram_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - STARTED_MB,
        "import_s": import_s,
    }


def peer(name: str, folder: Path, training: Sequence[Path]) -> dict[str, Any]:
    """Measure another way."""
    begin_s = time.process_time()
    import cv2
    import numpy as np

    from edgevpr.evaluate import metrics
    from edgevpr.evaluate.dataset import load_dataset
    from edgevpr.evaluate.quality import Quality, figures
    from edgevpr.frames.images import list_images
    from peers.ways import WAYS

    way = WAYS[name]()
    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)

    def grey(path: Path) -> np.ndarray:
        return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)

    known = way.learn([grey(path) for each in training for path in list_images(each / "ref")])
    dataset = load_dataset(folder / "query", folder / "ref", folder / "ground_truth.csv")
    places = [way.encode(grey(dataset.ref_dir / each), known) for each in dataset.references]
    index = way.index(places, known)
    scores, ranks, t_e_s, t_m_s = [], [], [], []
    for query in dataset.queries:
        picture = grey(query.path)
        begin_s = time.thread_time()
        asked = way.encode(picture, known)
        encoded_s = time.thread_time()
        row = way.scores(asked, index)
        t_m_s.append(time.thread_time() - encoded_s)
        t_e_s.append(encoded_s - begin_s)
        right = np.array([each in query.right for each in dataset.references])
        ignored = np.array([each in query.ignored for each in dataset.references])
        ranked = np.argsort(-row, kind="stable")
        ranked = ranked[metrics.counting(ranked, ignored)]
        scores.append(row[ranked[0]])
        ranks.append(metrics.first_right(ranked, right))
    quality = Quality(
        technique=name,
        queries=len(scores),
        references=len(dataset.references),
        **figures(np.array(scores), np.array(ranks)),
    )
    return {
        "set": folder.name,
        "quality": {key: value for key, value in asdict(quality).items() if key != "precision_recall"},
        "t_encode_ms": 1e3 * float(np.median(t_e_s)),
        "t_match_ms": 1e3 * float(np.median(t_m_s)),
        "bytes": float(way.nbytes(index, len(dataset.references))),
        "ram_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - STARTED_MB,
        "import_s": import_s,
    }


if __name__ == "__main__":
    name, camera, folder, *training = sys.argv[1:]
    measured = (
        ours(camera, Path(folder)) if name.startswith("cohog") else peer(name, Path(folder), list(map(Path, training)))
    )
    print(json.dumps(measured))
