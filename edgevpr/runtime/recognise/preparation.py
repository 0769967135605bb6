"""The preparation of a frame before it is searched for. Its picture is levelled or straightened, a mask leaves parts of
it out, the salience gate may reject it, and the stride to it is measured. A flight, `match`, `eval` and the making of
maps set it up; a flight changes it when it finds out how its camera is mounted (see `survey`)."""

from dataclasses import dataclass, replace

from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled, Mount, enlarged
from edgevpr.frames.mask import Mask
from edgevpr.places.layers import Layers
from edgevpr.runtime.recognise.levelling import Levelling, Straightening
from edgevpr.runtime.recognise.salience_gate import Gate
from edgevpr.runtime.recognise.stride import Strides


@dataclass(frozen=True, slots=True, kw_only=True)
class Preparation:
    """Preparation of a frame before it is searched for: `levelling` levels or straightens its picture, `mask` excludes
    parts of it, `gate` rejects frames that are not memorable, and `strides` measures the motion since the frame before
    (None: it is not done)."""

    levelling: Levelling | Straightening | None = None
    mask: Mask | None = None
    gate: Gate | None = None
    strides: Strides | None = None

    def picture(
        self, frame: Frame, vehicle: Vehicle | None = None, *, layers: Layers | None = None, scale: float = 1.0
    ) -> Levelled:
        """Return the levelled picture of a frame, with its mask and view. See `Levelling.prepare` for the rest."""
        mask = self.mask.fitted(frame.image) if self.mask else None
        if self.levelling is None:
            return enlarged(Levelled(frame.image, mask, UNKNOWN_VIEW), scale)
        return self.levelling.prepare(frame, vehicle, mask, layers=layers, scale=scale)

    def looking(self, mount: Mount) -> "Preparation":
        """Return the same for a camera that looks straight down but for `mount`. No stride leads to its first frame."""
        levelling = self.levelling.looking(mount) if isinstance(self.levelling, Levelling) else self.levelling
        return replace(self, levelling=levelling, strides=Strides() if self.strides else None)


AS_IT_IS = Preparation()
