"""Computations that several faults share; no file here is a fault.

Read ``intervals`` first: the motion over each interval, by the camera (`models.camera_motion`) and by the samples. From
both are computed ``one_step`` (residuals of tracks), ``alignment`` (the scale of vision and the position of the
camera), ``extrinsic`` (significance of a position and a rotation), ``integrated_gravity``, ``ratios`` (of sizes, and
units), ``clocks`` (offset and rate) and ``windows`` (comparison with a trajectory). ``self_calibration`` adjusts
windows of key frames (``bundle``) with integrated motion between them (``strides``); ``calibration_limits`` decides
which of its results are faults. For all: ``robust`` (statistics), ``edits`` (of a sequence), ``axes`` (conventions) and
``stamps`` (gaps).
"""
