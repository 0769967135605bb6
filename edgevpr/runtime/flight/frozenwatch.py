"""Detects frozen images. While the aircraft moves, images that do not change are frozen, even if noise, a clock or a
display hides this. So are images that repeat earlier ones of this flight, as from a clip that is played again.

Both equal an earlier image, although the aircraft has turned or flown too far for that. Rotation is the best
evidence, because gyroscopes measure it for every camera. Velocity times time over height is the second, for a camera
that looks down, as far as an autopilot that follows our own positions can be trusted. An image whose texture cannot
show a motion, as over water, in fog or in the dark, is not judged.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.config import SourceConfig
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.sameness import BLOCK_COUNT, CoarseImage, make_coarse
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.autopilot import AutopilotOutput
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.recognise.levelling import read_camera_lens
from edgevpr.runtime.recognise.recogniser import Recogniser

# Motions are fractions of the image's longest side. A motion of 0.012 is detected.
MIN_MOTION = 0.03  # least motion by the aircraft that contradicts an unmoved image
MIN_PROOF = 0.09  # sum of such motions that proves images frozen: a single reset of the heading does not
_MAX_SINGLE_MOTION = 0.04  # limit for one rotation, or one repeated image
_PROOF_WINDOW_S = 20.0
_MIN_FROZEN_S = 2.5  # of unchanged images, or between an image and its repetition
# This many consecutive repeated images in flight are sufficient proof, unless the aircraft has come back: on a lap that
# takes whole seconds, one image after another equals that of the lap before.
_MIN_REPEATS = 8
# Of the distance flown: an aircraft that is nearer to where it was has come back. A plane's dead reckoning was up to
# 0.3 of the distance wrong.
_MAX_RETURN_FRACTION = 0.5
_ROTATION_ERROR_DEG = 2.0  # due to attitude and time of the frame
_SPEED_ERROR_M_S = 2.0  # a lower speed counts as hovering
_PATH_DRIFT_M_S = 6.0  # of a path over a minute, due to changing wind
_MIN_FLIGHT_SPEED_M_S = 3.0
_MAX_HEIGHT_RATIO = 1.5  # the ground may be lower than the reported height implies
_MAX_SPEED_M_S = 100.0  # a larger reported velocity is wrong
_MAX_HEIGHT_M = 10_000.0  # a larger reported height is wrong
_MIN_HEIGHT_M = 5.0  # a smaller height above ground is too uncertain
_MAX_STEP_S = 5.0  # between images; the velocity is not integrated over a longer time
_HEADING_JUMP_DEG = 30.0  # a larger change of heading (plus the next, per second) is a correction by the autopilot
_HEADING_JUMP_DEG_S = 60.0
_RMS_RADIUS = 0.36  # root mean square distance of an image's points from its centre
_MAX_FOV_DEG = 120.0  # assumed for an unknown lens
_MIN_UNMOVED_FRACTION = 0.75  # of the blocks of the same image
_MIN_BLOCKS = BLOCK_COUNT // 3  # that can be judged
_STATIC_MEMORY = 8  # images: time constant of the fraction of images in which a block stays while most others move
_MAX_STATIC_FRACTION = 0.5  # of the blocks, in an image used to find the blocks that never move
_MAX_REMEMBERED = 300  # images; 4 MB
_REMEMBER_INTERVAL_S = 0.5
_MIN_THUMB_CORRELATION = 0.97  # of the coarsest copies
_MAX_CANDIDATES = 3  # earlier images that are compared block by block
_NEW_AFTER_UNCHANGED = 3  # new images after which the camera counts as working again
_NEW_AFTER_REPEATS = 10  # the same, after a repeated clip


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """The effect of the aircraft's motion on the images of its camera. `focal`: focal length as a fraction of the
    image's longest side. `looks_down`: False if it looks ahead. `is_level`: a gimbal compensates roll and pitch."""

    focal: float
    looks_down: bool
    is_level: bool

    def compute_rotation_motion(self, earlier: Vehicle | None, now: Vehicle | None) -> float:
        """Return the least motion of an image due to the aircraft's rotation between two reports; 0 if unknown."""
        if earlier is None or now is None:
            return 0.0
        names = "roll_deg", "pitch_deg", "heading_deg"
        roll_deg, pitch_deg, yaw_deg = (_compute_change_deg(earlier, now, name) for name in names)
        if self.is_level:
            roll_deg = pitch_deg = 0.0
        across_deg, about_deg = (roll_deg, yaw_deg) if self.looks_down else (yaw_deg, roll_deg)
        shift = self.focal * _subtract_error(math.hypot(across_deg, pitch_deg))
        return math.hypot(min(1.0, shift), _RMS_RADIUS * _subtract_error(about_deg))

    def compute_travel_motion(self, earlier: "TimedImage", now: "TimedImage", speed_error_m_s: float) -> float:
        """Return the least motion of an image due to the way flown since an earlier one; 0 if the camera does not look
        down, or the height is unknown."""
        height_m = now.vehicle.height_m if now.vehicle else None
        if not self.looks_down or height_m is None or not _MIN_HEIGHT_M <= height_m <= _MAX_HEIGHT_M:
            return 0.0
        moved_m = now.compute_displacement_m(earlier) - speed_error_m_s * (now.t_s - earlier.t_s)
        return max(0.0, moved_m) * self.focal / (_MAX_HEIGHT_RATIO * height_m)


def read_optics(source: SourceConfig, recogniser: Recogniser) -> Optics:
    """Return the optics of a configured camera; an unknown lens is assumed to be the widest usual one."""
    lens = read_camera_lens(source)
    focal = 0.5 / math.tan(math.radians(lens.fov_deg if lens else _MAX_FOV_DEG) / 2)
    looks_down = recogniser.technique.spec.looks_down
    return Optics(focal=focal, looks_down=looks_down, is_level=source.gimbal)


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedImage:
    """An image with the autopilot's report at its time (`vehicle`; None: no report). `path_m` (2,): displacement since
    the start of the flight, integrated from velocities, metres east and north; `distance_m`: its length."""

    image: CoarseImage
    t_s: float
    vehicle: Vehicle | None
    path_m: Doubles
    distance_m: float

    def compute_displacement_m(self, earlier: "TimedImage") -> float:
        """Return the straight distance from where an earlier image was taken."""
        return float(np.hypot(*(self.path_m - earlier.path_m)))

    def has_returned_to(self, earlier: "TimedImage") -> bool:
        """Return True if the aircraft has flown away from where an earlier image was taken, and come back."""
        return self.compute_displacement_m(earlier) < _MAX_RETURN_FRACTION * (self.distance_m - earlier.distance_m)


class FrozenWatch:
    """Judges each image of a live camera before it is recognised, and reports once when images are frozen
    (`is_frozen`) and once when they change again. Some have been recognised by then, so the navigation of the
    `autopilot` (None: no link) is reset, so that no position sent later depends on them."""

    def __init__(self, notifier: Notifier, optics: Optics, autopilot: AutopilotOutput | None = None) -> None:
        self.is_frozen = False
        self._notifier, self._optics, self._autopilot = notifier, optics, autopilot
        self._run_start: TimedImage | None = None  # first of a run of equal images
        self._newest: TimedImage | None = None
        self._rotation_start: Vehicle | None = None
        self._travel_motion = 0.0
        self._rotations: deque[tuple[float, float]] = deque()  # in this run: time and motion of each
        self._repeats: deque[tuple[float, float]] = deque()
        self._static_fractions = np.zeros(BLOCK_COUNT)  # of recent images in which a block stayed while others moved
        self._remembered: deque[TimedImage] = deque(maxlen=_MAX_REMEMBERED)
        self._repeats_in_a_row = self._new_in_a_row = self._new_needed = 0

    @property
    def reason(self) -> Reason | None:
        """Reason to refuse images while they are frozen, else None."""
        if not self.is_frozen:
            return None
        is_repeating = self._new_needed == _NEW_AFTER_REPEATS
        return Reason(ReasonCode.IMAGES_REPEATED if is_repeating else ReasonCode.IMAGES_UNCHANGED)

    def judge(self, frame: Frame, vehicle: Vehicle | None) -> Reason | None:
        """Judge the next image, with the autopilot's report at its time. Return the reason to refuse it, or None."""
        if vehicle and not vehicle.is_fresh(frame.t_mono_s):
            vehicle = None
        now = self._locate_image(make_coarse(frame.image), frame.t_mono_s, vehicle)
        first = self._run_start
        is_same = None if first is None else self._is_same(first.image, now.image, updates_static=True)
        if first and is_same:
            self._handle_same(first, now)
        else:
            is_repeat = self._find_repeat(now)
            if is_same is False and not is_repeat:
                self._new_in_a_row += 1
                self._repeats_in_a_row = 0
            self._start_run(now)
        self._newest = now
        self._update_verdict(now.t_s)
        return self.reason

    def _locate_image(self, image: CoarseImage, t_s: float, vehicle: Vehicle | None) -> TimedImage:
        last, path_m, distance_m = self._newest, np.zeros(2), 0.0
        if last:
            path_m, distance_m = last.path_m, last.distance_m
            last_velocity_m_s, velocity_m_s = _read_velocity(last.vehicle), _read_velocity(vehicle)
            if last_velocity_m_s and velocity_m_s and 0 < t_s - last.t_s <= _MAX_STEP_S:
                step_m = (t_s - last.t_s) * np.mean([last_velocity_m_s, velocity_m_s], axis=0)
                path_m, distance_m = path_m + step_m, distance_m + float(np.hypot(*step_m))
            if _has_jumped(last, vehicle, t_s):
                self._remembered.clear()
        return TimedImage(image=image, t_s=t_s, vehicle=vehicle, path_m=path_m, distance_m=distance_m)

    def _start_run(self, now: TimedImage) -> None:
        self._run_start, self._rotation_start, self._travel_motion = now, now.vehicle, 0.0
        self._rotations.clear()
        last = self._remembered[-1] if self._remembered else None
        if last is None or now.t_s - last.t_s >= _REMEMBER_INTERVAL_S:
            self._remembered.append(replace(now, image=CoarseImage(now.image.grey)))

    def _handle_same(self, first: TimedImage, now: TimedImage) -> None:
        """Process an image that equals the first one of its run of equal images."""
        self._new_in_a_row = 0
        travel_motion = self._optics.compute_travel_motion(first, now, _SPEED_ERROR_M_S)
        self._travel_motion = max(self._travel_motion, travel_motion)
        rotation_motion = self._optics.compute_rotation_motion(self._rotation_start, now.vehicle)
        if rotation_motion >= MIN_MOTION:
            self._rotations.append((now.t_s, min(rotation_motion, _MAX_SINGLE_MOTION)))
        if rotation_motion >= MIN_MOTION or self._rotation_start is None:
            self._rotation_start = now.vehicle

    def _find_repeat(self, now: TimedImage) -> bool:
        """Return whether an image equals an earlier one of the flight, and count the motion that contradicts this."""
        if not self._remembered:
            return False
        correlations = np.array([remembered.image.thumb for remembered in self._remembered]) @ now.image.thumb
        for index in np.argsort(correlations)[: -_MAX_CANDIDATES - 1 : -1].tolist():
            earlier = self._remembered[index]
            # Copies are stored and compared without blocks: the blocks of all remembered images would take 20 MB.
            is_similar = correlations[index] >= _MIN_THUMB_CORRELATION
            if is_similar and self._is_same(CoarseImage(earlier.image.grey), now.image):
                self._handle_repeat(earlier, now)
                return True
        return False

    def _handle_repeat(self, earlier: TimedImage, now: TimedImage) -> None:
        self._new_in_a_row = 0
        if now.t_s - earlier.t_s < _MIN_FROZEN_S:
            return
        velocity_m_s = _read_velocity(now.vehicle)
        is_flying = velocity_m_s is not None and math.hypot(*velocity_m_s) >= _MIN_FLIGHT_SPEED_M_S
        motion = self._optics.compute_rotation_motion(earlier.vehicle, now.vehicle)
        if self._optics.looks_down and not now.has_returned_to(earlier):  # the horizon ahead looks the same for long
            self._repeats_in_a_row += is_flying
            motion = max(motion, self._optics.compute_travel_motion(earlier, now, _PATH_DRIFT_M_S))
        if motion >= MIN_MOTION:
            self._repeats.append((now.t_s, min(motion, _MAX_SINGLE_MOTION)))

    def _is_same(self, earlier: CoarseImage, now: CoarseImage, updates_static: bool = False) -> bool | None:
        """Return True if two images are the same, unmoved; None if their texture cannot show a motion. Blocks that
        never move, as on a display or the airframe, are not used; with `updates_static`, they are updated."""
        textured, unmoved = earlier.is_textured, earlier.find_unmoved_blocks(now)
        judged = textured & (self._static_fractions < _MAX_STATIC_FRACTION)
        if updates_static and unmoved.sum() <= _MAX_STATIC_FRACTION * textured.sum():
            self._static_fractions += textured * (unmoved - self._static_fractions) / _STATIC_MEMORY
        return None if judged.sum() < _MIN_BLOCKS else bool(unmoved[judged].mean() >= _MIN_UNMOVED_FRACTION)

    def _update_verdict(self, now_s: float) -> None:
        """Decide whether images are frozen, from the motions of the last seconds that the images did not show."""
        for motions in (self._rotations, self._repeats):
            while motions and now_s - motions[0][0] > _PROOF_WINDOW_S:
                motions.popleft()
        unchanged_s = now_s - self._run_start.t_s if self._run_start else 0.0
        motion = self._travel_motion + sum(rotation for _, rotation in self._rotations)
        is_repeating = sum(repeat for _, repeat in self._repeats) >= MIN_PROOF
        if motion >= MIN_PROOF and unchanged_s >= _MIN_FROZEN_S:
            self._report(_NEW_AFTER_UNCHANGED)
        elif is_repeating or self._repeats_in_a_row >= _MIN_REPEATS:
            self._report(_NEW_AFTER_REPEATS)
        elif self.is_frozen and self._new_in_a_row >= self._new_needed:
            self.is_frozen = False
            note = Reason(ReasonCode.IMAGES_CHANGE_AGAIN)
            self._notifier.report("source", Severity.INFO, note, topic="frozen", state=str(note))

    def _report(self, new_needed: int) -> None:
        was_frozen, self.is_frozen = self.is_frozen, True
        self._new_needed = max(new_needed, self._new_needed if was_frozen else 0)
        if was_frozen:
            return
        if self._autopilot:
            self._autopilot.reset_navigation()
        if reason := self.reason:
            self._notifier.report("source", Severity.WARNING, reason, topic="frozen", state=str(reason))


def _read_velocity(vehicle: Vehicle | None) -> tuple[float, float] | None:
    """Return a reported velocity; None if it is unknown or impossible."""
    velocity_m_s = vehicle.velocity_m_s if vehicle else None
    return velocity_m_s if velocity_m_s and math.hypot(*velocity_m_s) <= _MAX_SPEED_M_S else None


def _compute_change_deg(earlier: Vehicle, now: Vehicle, name: str) -> float:
    """Return the change of an angle; 0 if it is unknown."""
    earlier_deg, now_deg = getattr(earlier, name), getattr(now, name)
    if earlier_deg is None or now_deg is None or not math.isfinite(earlier_deg + now_deg):
        return 0.0
    return float(wrap_deg(now_deg - earlier_deg))


def _subtract_error(angle_deg: float) -> float:
    return math.radians(max(0.0, abs(angle_deg) - _ROTATION_ERROR_DEG))


def _has_jumped(last: TimedImage, vehicle: Vehicle | None, t_s: float) -> bool:
    """Return True if the heading has changed faster than an aircraft can turn."""
    if last.vehicle is None or vehicle is None:
        return False
    rotation_deg = abs(_compute_change_deg(last.vehicle, vehicle, "heading_deg"))
    return rotation_deg > _HEADING_JUMP_DEG + _HEADING_JUMP_DEG_S * max(0.0, t_s - last.t_s)
