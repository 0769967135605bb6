"""Assigns the images of a folder to the camera triggers that an autopilot logged. A count that agrees proves nothing: a
test image on the ground and a trigger that the camera missed shift all images in between by one place. The times of the
images show it, even if the clock of the camera is wrong."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.frames.positions import GeoTag

ZONE_STEP_S = 900  # time zones are multiples of a quarter of an hour
_WHOLE_SECONDS_TOLERANCE_S = 0.9  # times of images without fractions, and the delay of the shutter
_FRACTIONS_TOLERANCE_S = 0.5
_IN_ORDER = "in the order of the autopilot's camera triggers"
_MIN_FRACTION_MATCHED = 0.8  # of the images
_MAX_COMPARED = 300  # images from which the clock of the camera is estimated
_MAX_OFFSETS = 20  # clock offsets compared in detail
# Another offset is as good if it matches this fraction of the images, unless they lie this much farther from triggers.
_MIN_RIVAL = 0.9
_MIN_LEAD = 1.5
_MAX_CLOCK_ERROR_S = 1.5  # of a camera whose clock was set


def match_triggers(shots: Sequence[GeoTag], exif_tags: Mapping[str, GeoTag]) -> tuple[dict[str, GeoTag], str] | None:
    """Return the tag of each image that a trigger took, by name, and in words how they were matched; None if they do
    not fit. `shots`: the tag of each trigger, in order. `exif_tags`: those of the images, in the order of their names.
    Without times, only their numbers are compared."""
    image_times_s, trigger_times_s = (
        np.array([tag.t_utc_s if tag.t_utc_s is not None else np.nan for tag in tags])
        for tags in (exif_tags.values(), shots)
    )
    if np.isnan([*image_times_s, *trigger_times_s]).any() or not np.ptp(image_times_s):
        return (dict(zip(exif_tags, shots, strict=True)), _IN_ORDER) if len(shots) == len(exif_tags) else None
    order = np.argsort(image_times_s, kind="stable")
    names = [list(exif_tags)[index] for index in order]
    image_times_s, trigger_order = image_times_s[order], np.argsort(trigger_times_s, kind="stable")
    trigger_times_s, shots = trigger_times_s[trigger_order], [shots[index] for index in trigger_order]
    tolerance_s = _FRACTIONS_TOLERANCE_S if np.any(image_times_s % 1) else _WHOLE_SECONDS_TOLERANCE_S
    if len(shots) == len(names):
        difference_s = trigger_times_s - image_times_s
        if np.abs(difference_s - np.median(difference_s)).max() <= tolerance_s:
            is_renamed = names != list(exif_tags)
            how = f"{_IN_ORDER}, images by time (not the order of their names)" if is_renamed else _IN_ORDER
            return dict(zip(names, shots, strict=True)), how
    offset_s = _estimate_offset_s(image_times_s, trigger_times_s, tolerance_s)
    if offset_s is None:
        return None
    pairs = _pair_nearest(image_times_s + offset_s, trigger_times_s, tolerance_s)
    intervals_s = np.diff(trigger_times_s[[trigger for _, trigger in pairs]])
    is_coarse = len(intervals_s) > 0 and np.median(intervals_s) < 2 * tolerance_s  # the nearest may be the next one
    if len(pairs) < _MIN_FRACTION_MATCHED * len(names) or is_coarse:
        return None
    how = f"by the times of the autopilot's {len(shots)} camera triggers"
    if unmatched := len(names) - len(pairs):
        how += f", {unmatched} of {len(names)} images without one"
    return {names[image]: shots[trigger] for image, trigger in pairs}, how


def _estimate_offset_s(image_times_s: Doubles, trigger_times_s: Doubles, tolerance_s: float) -> float | None:
    """Return the seconds to add to the clock of the camera so that most of its images coincide with a trigger; None if
    others fit as well, as with triggers at equal intervals, and none is that of a right clock in some time zone."""
    sample_s = image_times_s[:: max(1, len(image_times_s) // _MAX_COMPARED)]
    differences_s = (trigger_times_s - sample_s[:, None]).ravel()
    bins, counts = np.unique(np.round(differences_s / tolerance_s).astype(np.int64), return_counts=True)
    off_zone_s = bins * tolerance_s - ZONE_STEP_S * np.round(bins * tolerance_s / ZONE_STEP_S)
    in_zones = bins[np.abs(off_zone_s) <= _MAX_CLOCK_ERROR_S + tolerance_s / 2]
    fits = []
    for bin_number in {*bins[np.argsort(-counts, kind="stable")[:_MAX_OFFSETS]].tolist(), *in_zones.tolist()}:
        near_s = differences_s[np.abs(differences_s - bin_number * tolerance_s) <= tolerance_s]
        offset_s = float(np.median(near_s))
        distances_s = np.abs(trigger_times_s - (sample_s + offset_s)[:, None]).min(axis=1)
        is_matched = distances_s <= tolerance_s
        fits.append((int(is_matched.sum()), -float(distances_s[is_matched].sum()), offset_s))
    best = count, distance_s, best_s = max(fits)
    rivals = [fit for fit in fits if fit[0] >= _MIN_RIVAL * count and abs(fit[2] - best_s) > 2 * tolerance_s]
    if not any(rival_distance_s >= _MIN_LEAD * distance_s for _, rival_distance_s, _ in rivals):
        return best_s
    zoned = [fit for fit in (best, *rivals) if abs(math.remainder(fit[2], ZONE_STEP_S)) <= _MAX_CLOCK_ERROR_S]
    return max(zoned)[2] if zoned and np.ptp([fit[2] for fit in zoned]) <= 2 * tolerance_s else None


def _pair_nearest(image_times_s: Doubles, trigger_times_s: Doubles, tolerance_s: float) -> list[tuple[int, int]]:
    """Return (image, trigger) for each image with a trigger at its time. Each trigger is used once."""
    pairs, next_trigger = [], 0
    for image, time_s in enumerate(image_times_s.tolist()):
        distances_s = np.abs(trigger_times_s[next_trigger:] - time_s)
        if len(distances_s) and distances_s.min() <= tolerance_s:
            trigger = next_trigger + int(distances_s.argmin())
            pairs.append((image, trigger))
            next_trigger = trigger + 1
    return pairs
