"""The salience gate: passes the frames that are memorable, static and rich in information (thesis 3.2.4).

The entropy threshold is meant for daylight. At night or in fog all frames have less entropy, but the best of them are
still worth keeping. So a frame lacks entropy only if it has less than the threshold *and* less than usual in this light
(the thesis has a constant threshold). The usual entropy is computed from the upper half of the previous frames,
since a long stretch of sky or water changes only the lower half. Until there are enough, half the threshold applies.

If none of 20 frames passes, all thresholds are lowered (thesis 3.4.8)."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.core.arrays import Image, Mask
from edgevpr.core.config import SalienceConfig
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Salience
from edgevpr.runtime.recognise.gate_networks import Detector, Memorability, interpolate_map
from edgevpr.techniques.entropy import compute_filled_bins

MAX_ENTROPY = float(np.log2(81) / 8)  # entropy of a disc of 81 pixels, all different, divided by 8 bits
GAP_FRAMES = 20  # if none of this many frames passes, the thresholds are lowered
THRESHOLD_STEP = 0.03  # size of the steps in which they are lowered
_MIN_FRAMES = 8  # needed to compute the usual entropy
_MAX_FRAMES = 100
# A tenth of a normal distribution is more than this many differences of its 90th and 75th percentiles below the 75th.
_USUAL_LIMIT_STEPS = 3.2
_MIN_STEP = 0.005
_MAX_PX = 320  # of the copy used for entropy: a larger one costs more and gives the same result


@dataclass(frozen=True, slots=True)
class SalienceVerdict:
    """Judgement of a frame by its `scores`. `shortfall` is how far the worst score is below its threshold,
    `criterion` the name of that score, and `reason` the refusal (0 and None: the frame passes)."""

    scores: Salience
    shortfall: float = 0.0
    criterion: str | None = None
    reason: Reason | None = None


class SalienceGate:
    """Judges the frames of a flight in order.

    `memorability` and `detector` are None if their criterion is off. The detector runs on every k-th frame only (k =
    `detect_every` of the configuration), and its result is used until the next."""

    def __init__(
        self, config: SalienceConfig, memorability: Memorability | None = None, detector: Detector | None = None
    ) -> None:
        self.config, self._memorability, self._detector = config, memorability, detector
        self.reset()

    def reset(self) -> None:
        """Prepare for another flight: discard the entropy history and the last result of the detector."""
        self._entropies: deque[float] = deque(maxlen=_MAX_FRAMES)
        self._until_detection = 0
        self._static: Mask | None = None

    def judge(self, image: Image) -> SalienceVerdict:
        """Judge a frame, uint8 (H, W[, 3]). Raises ModelError for an unusable network."""
        scores = self.scores(image)
        self._entropies.append(scores.entropy or 0.0)
        # At the start of a flight the light is unknown; half of the threshold still rejects an empty image.
        usual = self.config.entropy / 2
        if len(self._entropies) >= _MIN_FRAMES:
            p75, p90 = np.percentile(self._entropies, (75, 90))
            usual = float(p75 - _USUAL_LIMIT_STEPS * max(p90 - p75, _MIN_STEP))
        return judge_scores(scores, self.config, usual)

    def scores(self, image: Image) -> Salience:
        """Return the scores of a frame. Raises ModelError as `judge` does."""
        if self._detector:
            if self._until_detection == 0 or self._static is None or self._static.shape != image.shape[:2]:
                self._static, self._until_detection = None, self.config.detect_every  # None, if the detector fails
                self._static = self._detector.is_static(image)
            self._until_detection -= 1
        return compute_scores(image, self._memorability, self._static)


def judge_scores(salience: Salience, config: SalienceConfig, usual: float = 1.0) -> SalienceVerdict:
    """Compare the scores of a frame (None: skipped) with their thresholds, entropy with `usual` if that is lower."""
    known = salience.scores
    min_scores = {name: getattr(config, name) for name in known} | {"entropy": min(config.entropy, usual)}
    gaps = {name: min_scores[name] - score for name, score in known.items() if score is not None}
    shortfalls = {name: gap for name, gap in gaps.items() if min_scores[name] > 0}
    worst = max(shortfalls, key=lambda name: shortfalls[name], default=None)
    if worst is None or shortfalls[worst] <= 0:
        return SalienceVerdict(salience)
    figures = {"measure": worst, "score": known[worst], "min_score": min_scores[worst]}
    return SalienceVerdict(salience, shortfalls[worst], worst, Reason(ReasonCode.NOT_MEMORABLE, figures))


def select_best(shortfalls: list[float]) -> list[bool]:
    """Select the best of several frames: lower all thresholds in steps of 0.03 until at least one frame passes. Return
    for each frame whether it then passes; `shortfalls` are the frames' `SalienceVerdict.shortfall`."""
    steps = np.ceil(np.round(np.array(shortfalls) / THRESHOLD_STEP, 6))
    return [bool(step == steps.min()) for step in steps]


def compute_scores(image: Image, memorability: Memorability | None = None, is_static: Mask | None = None) -> Salience:
    """Return the scores of an image, uint8 (H, W[, 3]): means over a copy with a longer side of at most 320 pixels.
    Pixels that are not static count as 0 in the other two scores, because an image with many of them is less useful.

    `is_static`, bool (H, W), is the detector's result for the image (None: no detector). Raises ModelError."""
    shrink, grey = _MAX_PX / max(image.shape[:2]), image
    if shrink < 1:
        size = tuple(max(1, round(side * shrink)) for side in image.shape[1::-1])
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    if image.ndim == 3:
        grey = np.asarray(cv2.cvtColor(grey, cv2.COLOR_BGR2GRAY), np.uint8)
    if is_static is not None:
        covered = cv2.resize((~is_static).astype(np.float32), grey.shape[::-1], interpolation=cv2.INTER_AREA)
        is_static = covered < 0.5
    static = 1.0 if is_static is None else is_static
    memorable = None if memorability is None else interpolate_map(memorability.compute_matrix(image), grey.shape)
    return Salience(
        memorability=None if memorable is None else float((memorable * static).mean()),
        staticity=None if is_static is None else float(is_static.mean()),
        entropy=float((compute_filled_bins(grey) * static).mean()),
    )
