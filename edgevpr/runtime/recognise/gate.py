"""The gate: refuses a picture that says nothing, before anything is searched for.

Screens without a signal, displays on a dark ground, bare sky, a covered lens: such a picture has few regions that hold
information. The share of regions that agree on a place is then the share of a few, and reaches any limit by chance.
"""

from edgevpr.contract import Descriptor

# Least share of a picture that holds information. Without the gate, the pictures of nothing that were accepted on the
# tuning sets had .39 or less, and washed-out or covered pictures that were taken for a wrong place .43 or less; right
# matches had .91 or more (on the other sets .72, and .47 where pictures have 64 x 32 pixels).
MIN_QUALITY = 0.4


def says_nothing(query: Descriptor) -> str | None:
    """Return the reason why a picture says too little to be recognised, None where it says enough."""
    if query.quality >= MIN_QUALITY:
        return None
    return f"the picture says nothing: {query.quality:.0%} of it holds information, {MIN_QUALITY:.0%} are needed"
