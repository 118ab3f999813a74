"""Computations that several faults share; no file here is a fault.

Read ``intervals`` first: the motion over each interval, by the camera (`models.camera_motion`) and by the samples.
Then what is computed of both: ``one_step`` (residuals of tracks), ``alignment`` (scale and position of the camera),
``extrinsic`` (position and rotation, judged), ``integrated_gravity``, ``ratios``, ``clocks`` (offset and rate of
clocks) and ``windows`` (motion beside a trajectory's). ``self_calibration`` adjusts a ``bundle`` of key frames beside
``strides`` of integrated motion; ``calibration_limits`` says what of it is wrong. For all: ``robust`` (statistics),
``edits`` (of a sequence), ``axes`` (their conventions) and ``stamps``.
"""
