"""Time stamps: the step that is a gap, and the value that is no time."""

import numpy as np

# A step this many times the usual (median) one is a gap: one missing stamp makes a step of 2, two make 3.
GAP_RATIO = 3.5
# What a cast of NaN to int64 gives.
NOT_A_TIME = np.iinfo(np.int64).min
