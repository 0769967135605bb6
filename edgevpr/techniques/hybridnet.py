"""`hybridnet`: as `amosnet`, with other weights.

Chen et al., ICRA 2017; thesis 4.2.1. HybridNet has the layers of AMOSNet, the top five convolutional ones started from
CaffeNet instead of from scratch: the difference lies in the weights alone, so give their card as `model`. With the same
card both techniques are the same.
"""

from edgevpr.techniques.amosnet import AmosNet


class HybridNet(AmosNet):
    """See `AmosNet`."""

    name = "hybridnet"
