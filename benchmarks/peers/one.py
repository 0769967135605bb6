"""One piece of work of `peers.py`, in a process of its own, so that its memory is its own: prints JSON.

python -m peers.one map CAMERA SET FILE
python -m peers.one cohog CAMERA SET FILE
python -m peers.one learn WAY FILE SET ...
python -m peers.one way WAY SET FILE
python -m peers.one network NAME SET

Maps and words are made beforehand and come from a FILE: what is measured is a flight with them. Times are of the
processor. Of a set at most 200 queries are asked, evenly spaced.
"""

import json
import pickle
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

MOST_QUERIES = 200
_QUALITY = "recall", "precision_at", "auc", "queries", "references"
_NETWORK_PICTURES, _NETWORK_PLACES, _SEED = 11, 1000, 1


def make_map(camera: str, folder: str, file: str) -> dict[str, Any]:
    """Make a map of the references of a set, as `edgevpr map build` does."""
    from edgevpr.core.config import load_config
    from edgevpr.frames.source import open_source
    from edgevpr.lab.evaluate import evaluate
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.recognise.opening import meter_of
    from edgevpr.techniques import create

    images = Path(folder) / "ref"
    meter = meter_of(load_config(None), load_board("this"))
    frames = evaluate.all_frames(open_source(str(images), live=False))
    evaluate.make_map(Path(file), frames, create("cohog", {"camera": camera}), meter, images)
    return {"bytes": Path(file).stat().st_size}


def cohog(camera: str, folder: str, file: str) -> dict[str, Any]:
    """Measure edgevpr's own, as it flies."""
    begin_s = time.process_time()
    import cv2
    import numpy as np

    from edgevpr.core.config import load_config
    from edgevpr.lab.evaluate.asking import Asking, Walk, answers
    from edgevpr.lab.evaluate.evaluate import opened, summary
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.recognise.opening import meter_of
    from edgevpr.techniques import create

    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)
    dataset, technique = _dataset(folder), create("cohog", {"camera": camera})
    with opened(Path(file), technique) as (place_map, index):
        walk = Walk(technique, place_map, index, meter_of(load_config(None), load_board("this")), asking=Asking())
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


def learn(name: str, file: str, *folders: str) -> dict[str, Any]:
    """Learn the words of a way on the references of these sets."""
    from edgevpr.frames.images import list_images
    from peers.ways import WAYS

    known = WAYS[name]().learn([_grey(path) for folder in folders for path in list_images(Path(folder) / "ref")])
    Path(file).write_bytes(pickle.dumps(known))
    return {}


def way(name: str, folder: str, file: str) -> dict[str, Any]:
    """Measure another way."""
    begin_s = time.process_time()
    import cv2
    import numpy as np

    from edgevpr.lab.evaluate import metrics
    from edgevpr.lab.evaluate.quality import Quality, figures
    from peers.ways import WAYS

    it = WAYS[name]()
    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)
    dataset, known = _dataset(folder), pickle.loads(Path(file).read_bytes())
    places = [it.encode(_grey(dataset.ref_dir / each), known) for each in dataset.references]
    index = it.index(places, known)
    scores, ranks, t_encode_s, t_match_s = [], [], [], []
    for query in dataset.queries:
        picture = _grey(query.path)
        begin_s = time.process_time()
        asked = it.encode(picture, known)
        encoded_s = time.process_time()
        row = it.scores(asked, index)
        t_match_s.append(time.process_time() - encoded_s)
        t_encode_s.append(encoded_s - begin_s)
        right = np.array([each in query.right for each in dataset.references])
        ignored = np.array([each in query.ignored for each in dataset.references])
        ranked = np.argsort(-row, kind="stable")
        ranked = ranked[metrics.counting(ranked, ignored)]
        scores.append(row[ranked[0]])
        ranks.append(metrics.first_right(ranked, right))
    ram_mb = _peak_mb() - _STARTED_MB
    quality = Quality(
        technique=name,
        queries=len(scores),
        references=len(dataset.references),
        **figures(np.array(scores), np.array(ranks)),
    )
    return {
        "quality": _quality(asdict(quality)),
        "t_encode_ms": 1e3 * float(np.median(t_encode_s)),
        "t_match_ms": 1e3 * float(np.median(t_match_s)),
        "bytes": float(it.nbytes(index, len(dataset.references))),
        "ram_mb": ram_mb,
        "import_s": import_s,
    }


def network(name: str, folder: str) -> dict[str, Any]:
    """Measure the network of a card, on pictures of a set, against 1,000 places of any content."""
    begin_s = time.process_time()
    import cv2
    import numpy as np

    from edgevpr.frames.images import list_images, read_image
    from edgevpr.techniques import create
    from edgevpr.techniques.networks.card import load_card
    from edgevpr.techniques.networks.session import import_onnxruntime

    import_onnxruntime()
    import_s = time.process_time() - begin_s
    cv2.setNumThreads(1)
    begin_s = time.process_time()
    technique = create(name)
    open_s = time.process_time() - begin_s
    rng, rows = np.random.default_rng(_SEED), np.empty((_NETWORK_PLACES, *technique.spec.coarse.shape), np.float16)
    for row in rows:
        row[:] = rng.normal(size=row.shape)
    t_encode_s, t_match_s = [], []
    for path in list_images(Path(folder) / "ref")[:_NETWORK_PICTURES]:
        picture = read_image(path)
        begin_s = time.process_time()
        asked = technique.encode(picture)
        encoded_s = time.process_time()
        technique.coarse_scores(asked, rows)
        t_match_s.append(time.process_time() - encoded_s)
        t_encode_s.append(encoded_s - begin_s)
    ram_mb = _peak_mb() - _STARTED_MB
    return {
        "t_encode_ms": 1e3 * float(np.median(t_encode_s[1:])),  # the first one pays for what is made once
        "t_match_ms": 1e3 * float(np.median(t_match_s[1:])),
        "bytes": technique.spec.row.nbytes,
        "length": technique.spec.coarse.shape[0],
        "file_mb": load_card(name).file_path.stat().st_size / 1e6,
        "bytes_1bit": create(name, {"form": "1bit"}).spec.row.nbytes,
        "open_s": open_s,
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


def _grey(path: Path) -> Any:
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def _quality(found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key.startswith(_QUALITY)}


def main(words: Sequence[str]) -> None:
    """Do the work that is named, and print what it returns."""
    work = {"map": make_map, "cohog": cohog, "learn": learn, "way": way, "network": network}
    print(json.dumps(work[words[0]](*words[1:])))


_STARTED_MB = _peak_mb()  # of the bare interpreter: nothing large is imported yet

if __name__ == "__main__":
    main(sys.argv[1:])
