"""Constants of `cohog`, most of them per camera direction, and the data from which they were chosen."""

from edgevpr.techniques.layout import ROTATIONS

# The goodness threshold GT of the thesis (6.3.2) and of the authors' public code, each for the entropy used there.
DEFAULT_GT = {"filled_bins": 0.5, "shannon": 0.4}
# Weight of a vote that is 0, 1, 2 ... cells from the peak. With a forward camera, near and far ground shift
# differently; with a nadir camera (one that looks straight down), the shift is more accurate.
VOTE_WEIGHTS = {"forward": (1.0, 1.0, 0.75, 0.5), "nadir": (1.0, 1.0)}
# (min_score, min_margin) for sequences: in corridor, the seasons and nordland_tiny no sequence of ten was accepted at a
# wrong place. The thesis's score has no safe threshold: its margin rejects queries of two other sites in the map of
# aerial_caliterra, but also most correct matches.
ACCEPT_LIMITS = {"forward": (0.02, 0.01), "nadir": (0.02, 0.01), "thesis": (0.0, 0.02)}
# Minimum quality. On the tuning sets, accepted pictures without texture had 0.39 or less, and washed-out or covered
# ones that matched a wrong place 0.43 or less; correct matches had 0.91 or more (0.72 or more on the other sites, and
# 0.47 with pictures of 64 x 32 pixels). With `filled_bins` these values were 0.14, 0.18 and 0.30.
MIN_QUALITY = {"shannon": 0.4, "filled_bins": 0.2}
# (min_levels, target_levels, sigma_pixels), see `stretch_contrast`. No place of any data set is below `min_levels` (one
# of aerial_copr has 45, one of nordland_tiny 81), so none is changed. Chosen on corridor, aerial_caliterra and
# aerial_garfield28, with aerial_swindale: noise does more harm with a forward camera.
CONTRAST = {"forward": (75, 200, 0.4), "nadir": (40, 40, 0.25)}
MATCHINGS = ("displacement", "thesis")
# Candidate places or, with a nadir camera, pairs of a place and a rotation.
CANDIDATES = {"forward": 42, "nadir": 30}
# Places compared in full: those with the best quick scores (forward: from every fourth good region). On corridor, the
# seasons and nordland_tiny, 12 of 42 compared in full find as many places as all (four fewer of the 994 of
# nordland_tiny). With a nadir camera, 6 of 30 find as many as 10 on sat_marash, aerial_swindale and kite_ochota.
MAX_MATCHES = {"forward": 12, "nadir": 6}
QUICK_STEP = 4
NADIR_BINS = 8  # orientations of the regions whose patterns form a layout
# Agreement of the layouts of query and place at which the score equals the fraction of votes. Correct matches on
# sat_marash have 0.18 to 0.38, within one season up to 0.5. At 0.35 one foreign picture was accepted in the map of
# aerial_caliterra, at 0.4 and above none in the maps of sat_marash, kite_ochota, aerial_swindale and aerial_caliterra.
FULL_LAYOUT_AGREEMENT = 0.45
# Surroundings of a region in the structure of a picture (see `overlay`). A forward camera sees larger objects.
SURROUND_SD_CELLS = {"forward": 5.0, "nadir": 3.0}
MIN_ROTATED_DEG = 45.0  # minimum angle between two rotations that count as different
# A match keeps its score if the agreement of its structures reaches the upper limit; below the lower limit, that limit
# is used. Foreign pictures have at most 4.9 forward and 2.7 nadir; wrong places in the uniform corridor have 9.9.
STRUCTURE_LIMITS = {"forward": (1.0, 6.0), "nadir": (1.0, 3.0)}
MAX_HEADING_OFF_DEG = 1.5 * 360 / ROTATIONS  # covers the expected rotation and one step on either side
