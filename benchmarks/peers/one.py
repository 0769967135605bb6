"""One piece of work of `peers.py`, in a process of its own, so that its memory is its own: prints JSON.

python one.py cohog CAMERA SET FILE
python one.py way WAY SET FILE

Maps and words are made beforehand and come from a FILE: what is measured is a flight with them. Times are of the
processor. Of a set at most 200 queries are asked, evenly spaced.
"""

import json
import pickle
import re
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

MOST_QUERIES = 200
_QUALITY = "recall", "precision_at", "auc", "queries", "references"


def cohog(camera: str, folder: str, file: str) -> dict[str, Any]:
    """Measure edgevpr's own, as it flies."""
    begin_s = time.process_time()
    import cv2
    import numpy as np

    from edgevpr.lab.evaluate.asking import MatchOptions, Walk, answers
    from edgevpr.lab.evaluate.evaluate import opened, own_meter, summary
    from edgevpr.techniques import create

    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)
    dataset, technique = _dataset(folder), create("cohog", {"camera": camera})
    with opened(Path(file), technique) as (place_map, index):
        walk = Walk(technique, place_map, index, own_meter(), options=MatchOptions())
        walk.warm_up(dataset.queries[0].path)
        found = list(answers(walk, dataset, lambda paths, count, label: paths))
    ram_mb = _peak_mb() - _STARTED_MB  # the figures of quality load SciPy, and a flight does not
    result = summary(technique, len(dataset.references), found)
    return {
        "quality": _quality(asdict(result)),
        "t_encode_ms": 1e3 * float(np.median([each.encoding.cpu_s for each in found])),
        "t_match_ms": 1e3 * float(np.median([each.matching.cpu_s for each in found])),
        "bytes": result.descriptor_bytes,
        "file_bytes": Path(file).stat().st_size / len(dataset.references),
        "ram_mb": ram_mb,
        "import_s": import_s,
    }


def way(name: str, folder: str, file: str) -> dict[str, Any]:
    """Measure another way."""
    begin_s = time.process_time()
    import cv2
    import numpy as np
    from ways import WAYS

    from edgevpr.lab.evaluate import metrics
    from edgevpr.lab.evaluate.metrics import figures

    it = WAYS[name]()
    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)
    dataset, known = _dataset(folder), pickle.loads(Path(file).read_bytes())
    index = it.index([it.encode(grey(dataset.ref_dir / each), known) for each in dataset.references], known)
    scores, ranks, times_ms = [], [], []
    for query in dataset.queries:
        picture = grey(query.path)
        begin_s = time.process_time()
        asked = it.encode(picture, known)
        encoded_s = time.process_time()
        row = it.scores(asked, index)
        times_ms.append((1e3 * (encoded_s - begin_s), 1e3 * (time.process_time() - encoded_s)))
        right = np.array([each in query.right for each in dataset.references])
        ranked = np.argsort(-row, kind="stable")
        ranked = ranked[metrics.counting(ranked, np.array([each in query.ignored for each in dataset.references]))]
        scores.append(row[ranked[0]])
        ranks.append(metrics.first_right(ranked, right))
    ram_mb = _peak_mb() - _STARTED_MB
    quality = {"queries": len(scores), "references": len(dataset.references)}
    t_encode_ms, t_match_ms = np.median(times_ms, axis=0).tolist()
    return {
        "quality": _quality(quality | figures(np.array(scores), np.array(ranks))),
        "t_encode_ms": t_encode_ms,
        "t_match_ms": t_match_ms,
        "bytes": float(it.nbytes(index, len(dataset.references))),
        "ram_mb": ram_mb,
        "import_s": import_s,
    }


def _peak_mb() -> float:
    """Return the highest resident memory of this process so far. What `getrusage` tells is at least that of the process
    which started this one."""
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1e3


def _dataset(folder: str) -> Any:
    from edgevpr.lab.evaluate.dataset import load_dataset

    whole = load_dataset(f"{folder}/query", f"{folder}/ref", f"{folder}/ground_truth.csv")
    return replace(whole, queries=whole.queries[:: -(-len(whole.queries) // MOST_QUERIES)])


def grey(path: Path) -> Any:
    """Read a picture, uint8 (H, W)."""
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def _quality(found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key.startswith(_QUALITY)}


_STARTED_MB = _peak_mb()  # of the bare interpreter: nothing large is imported yet

if __name__ == "__main__":
    print(json.dumps({"cohog": cohog, "way": way}[sys.argv[1]](*sys.argv[2:])))
