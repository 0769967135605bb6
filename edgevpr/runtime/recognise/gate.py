"""The gate: refuses a picture that says nothing, before anything is searched for.

Screens without a signal, displays on a dark ground, bare sky, a covered lens: such a picture has few regions that hold
information. The share of regions that agree on a place is then the share of a few, and reaches any limit by chance.
"""

from edgevpr.contract import Descriptor

# Least share of a picture that holds information. Of 690 pictures of nothing on corridor and as many on aerial_caliterra
# and on a generated flight, those that would have been accepted had .39 or less; of real pictures that were washed out or
# covered, those accepted as a wrong place .43 or less, and as a place more than three beside the right one .37. Right
# matches had .91 or more (.47 on nordland_tiny, of 64 x 32 pixels, and .72 elsewhere).
MIN_QUALITY = 0.4


def says_nothing(query: Descriptor) -> str | None:
    """Return the reason why a picture says too little to be recognised, None where it says enough."""
    if query.quality >= MIN_QUALITY:
        return None
    return f"the picture says nothing: {query.quality:.0%} of it holds information, {MIN_QUALITY:.0%} are needed"
