"""The first stage of recognition: encodes a frame as a query. Building and calibrating a map use it too."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.errors import EdgevprError, MapError, PlaceError
from edgevpr.core.reasons import NOT_SEARCHED, Reason, ReasonCode
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.level import UNKNOWN_VIEW, LevelledImage, Mount, View, enlarge_image
from edgevpr.frames.mask import OverlayMask
from edgevpr.frames.sameness import StripCheck
from edgevpr.places.layers import Layers
from edgevpr.runtime.recognise import landmarks
from edgevpr.runtime.recognise.levelling import Levelling, Undistortion
from edgevpr.runtime.recognise.salience_gate import SalienceGate, SalienceVerdict


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodedFrame:
    """A frame that was prepared and encoded. `vehicle`: the autopilot's report when it was taken (None: unknown).
    `salience`: judgement of the salience gate (None: there is no gate)."""

    frame: Frame
    vehicle: Vehicle | None = None
    picture: LevelledImage
    salience: SalienceVerdict | None = None
    descriptor: Descriptor

    @property
    def view(self) -> View:
        """View of the image: where on the ground it is, and at which scale."""
        return self.picture.view


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameEncoder:
    """Levels or undistorts the image of a frame (`levelling`), masks parts of it (`mask`), judges whether it is
    memorable (`gate`), and encodes it with the `technique`. A step that is None is skipped. See `StripCheck`."""

    technique: Technique
    levelling: Levelling | Undistortion | None = None
    mask: OverlayMask | None = None
    gate: SalienceGate | None = None
    strip: StripCheck = field(default_factory=StripCheck)

    def prepare(
        self, frame: Frame, vehicle: Vehicle | None = None, *, layers: Layers | None = None, scale: float = 1.0
    ) -> LevelledImage:
        """Return the levelled image of a frame, with mask and view. Other arguments: see `Levelling.prepare`."""
        mask = self.mask.fit_to(frame.image) if self.mask else None
        if self.levelling is None:
            return enlarge_image(LevelledImage(frame.image, mask, UNKNOWN_VIEW), scale)
        picture = self.levelling.prepare(frame, vehicle, mask, layers=layers, scale=scale)
        if self.technique.spec.looks_down and frame.pose is None:
            self.strip.add(frame.image)
        return replace(picture, view=replace(picture.view, axis_sd=self.strip.offset * picture.view.zoom))

    def encode(
        self,
        frame: Frame,
        vehicle: Vehicle | None = None,
        *,
        layers: Layers | None = None,
        scale: float = 1.0,
        metered: Callable[[str], AbstractContextManager[None]] = lambda step: nullcontext(),
    ) -> EncodedFrame:
        """Prepare, judge and encode a frame. `metered` returns a context that measures the step with the given name.
        Raises the errors of the technique and the gate."""
        with metered("prepare"):
            picture = self.prepare(frame, vehicle, layers=layers, scale=scale)
        with metered("gate"):
            salience = self.gate.judge(frame.image) if self.gate else None
        with metered("encode"):
            descriptor = self.technique.encode(picture.image, picture.mask)
        return EncodedFrame(frame=frame, vehicle=vehicle, picture=picture, salience=salience, descriptor=descriptor)

    def detect_landmarks(self, picture: LevelledImage, count: int = landmarks.PLACE_LANDMARKS) -> landmarks.Landmarks:
        """Detect the `count` best landmarks of an image, scaled to the size used for the landmarks of places."""
        longest_px = landmarks.DOWN_PX if self.technique.spec.looks_down else landmarks.AHEAD_PX
        return landmarks.detect_landmarks(picture.image, picture.mask, count, longest_px)

    def pack_landmarks(self, picture: LevelledImage) -> bytes | None:
        """Return the encoded landmarks to store for a place; None if the technique does not use them."""
        return landmarks.pack_bytes(self.detect_landmarks(picture)) if self.technique.spec.cells else None

    def replace_mount(self, mount: Mount) -> "FrameEncoder":
        """Return this encoder with the camera mounted at the angles `mount` from straight down."""
        if not isinstance(self.levelling, Levelling):
            return self
        return replace(self, levelling=self.levelling.replace_mount(mount))


def explain_failure(error: Exception | None) -> Reason:
    """Return the reason why a frame was not recognised; `error` is None if it was not searched. An error that is not
    edgevpr's own comes from a fault in a technique or a library."""
    match error:
        case None:
            return NOT_SEARCHED
        case PlaceError():
            return Reason(ReasonCode.PLACE_UNREADABLE, {"problem": str(error)})
        case MapError():
            return Reason(ReasonCode.MAP_UNREADABLE, {"problem": str(error)})
        case EdgevprError():
            return Reason(ReasonCode.UNUSABLE, {"problem": str(error)})
    return Reason(ReasonCode.UNEXPECTED_ERROR, {"error": type(error).__name__, "problem": str(error)})
