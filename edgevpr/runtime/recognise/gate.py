"""The gate: refuses a picture that says nothing, before anything is searched for.

Screens without a signal, displays on a dark ground, bare sky, a covered lens: such a picture has few regions that hold
information. The share of regions that agree on a place is then the share of a few, and reaches any limit by chance.
"""

from edgevpr.core.contract import Descriptor


def says_nothing(query: Descriptor, min_quality: float) -> str | None:
    """Return the reason why a picture says too little to be recognised, None where it says enough: its quality is at
    least `min_quality`."""
    if query.quality >= min_quality:  # False for NaN
        return None
    return f"the picture says nothing: {query.quality:.0%} of it holds information, {min_quality:.0%} are needed"
