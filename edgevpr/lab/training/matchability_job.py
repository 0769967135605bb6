"""The whole job of `edgevpr train matchability`: data sets in, labels, a checked ONNX file and its card out."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import require_folder
from edgevpr.core.text import progress
from edgevpr.frames.images import list_images
from edgevpr.lab.training.job import require_packages
from edgevpr.lab.training.labels import MATCHED, Labelled, label_site

_FEWEST_SITES, _FEWEST_FRAMES = 3, 8


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchabilityResult:
    """Result of a training. `unseen` has by kind of network, by sort of picture (`generated` changes and `real`
    queries) and by site the area under the ROC curve on a site that was left out (None: all its pictures are alike);
    `kind` is the one that was better, and is written. `classes` counts the pictures that are good or confusing (they
    look like another place more than half of their site does), and matched or mismatched (by most techniques)."""

    model: str
    card: str
    kind: str
    frames: int
    unseen: dict[str, dict[str, dict[str, float | None]]]
    classes: dict[str, int]
    largest_difference: float


def train_matchability(folders: Sequence[str], looks_down: Sequence[str], out: Path, seed: int) -> MatchabilityResult:
    """Label the frames of data sets, fit both kinds of network, and write the better one to `out` (ONNX) with its card.

    A data set is a folder with ref/, and query/ and ground_truth.csv where there are any; those of `looks_down` were
    taken looking straight down. Raises UsageError for settings that make no sense or files that exist already, and what
    `label_site` raises.
    """
    if out.suffix != ".onnx":
        raise UsageError(f"--out {out}: give a name that ends in .onnx.")
    card = out.with_suffix(".yaml")
    for path in (out, card):
        if path.exists():
            raise UsageError(f"{path} is there already: give another --out, or delete it.")
    sets = [(Path(name), False) for name in folders] + [(Path(name), True) for name in looks_down]
    if len(sets) < _FEWEST_SITES:
        raise UsageError(f"{len(sets)} data sets are too few: give {_FEWEST_SITES} at least, each of another site.")
    for folder, _ in sets:
        if len(list_images(folder / "ref")) < _FEWEST_FRAMES:
            raise UsageError(f"{folder}/ref has too few images to tell places apart: {_FEWEST_FRAMES} at least.")
    require_folder(out)
    require_packages()

    from edgevpr.lab.training import export_matchability as export
    from edgevpr.lab.training.matchability import compared, fit, site_of

    labels = {folder.name: label_site(folder, down, seed, progress) for folder, down in sets}
    sites = [site_of(name, labelled) for name, labelled in labels.items()]
    kind, unseen = compared(sites, seed)
    network = fit(kind, sites, seed)
    export.write_onnx(network, out)
    try:
        largest = export.require_equal(network, out, sites[0].inputs(0).numpy())
    except EdgevprError:
        out.unlink()
        raise
    frames = sum(map(len, labels.values()))
    source = (
        f"edgevpr train matchability --seed {seed}; {kind}; {frames} pictures of {', '.join(labels)}; on a site left "
        f"out {unseen[kind].mean:.2f} of pairs of changed pictures in the right order"
    )
    export.write_card(card, out, "Matchability, trained by edgevpr", source)
    return MatchabilityResult(
        model=str(out),
        card=str(card),
        kind=kind,
        frames=frames,
        unseen={each: asdict(found) for each, found in unseen.items()},
        classes=_classes(labels),
        largest_difference=largest,
    )


def _classes(labels: dict[str, list[Labelled]]) -> dict[str, int]:
    """Count the frames of the four classes of thesis 7.2, item 2."""
    counts = dict.fromkeys(("good, matched", "good, mismatched", "confusing, matched", "confusing, mismatched"), 0)
    for labelled in labels.values():
        usual = float(np.median([each.alike for each in labelled]))
        for each in labelled:
            like = "confusing" if each.alike > usual else "good"
            counts[f"{like}, {'matched' if each.found >= MATCHED else 'mismatched'}"] += 1
    return counts
