"""`hybridnet`: as `amosnet`, with other weights.

Chen et al., ICRA 2017; thesis 4.2.1. HybridNet has the layers of AMOSNet. Its top five convolutional layers were
started from CaffeNet instead of from scratch. Only the weights differ, so give their card as `model`. With the same
card both techniques are the same.
"""

from edgevpr.techniques.amosnet import AmosNet


class HybridNet(AmosNet):
    """HybridNet: `AmosNet` under another name."""

    name = "hybridnet"
