# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 1. Quickstart
#
# A car drives for 14 seconds. It carries an IMU and two cameras side by side. Where did it go?
#
# This notebook asks three estimators, lays their answers over each other and says how good they are. It takes a
# minute.

# %%
import numpy as np
from recordings import real

import toolkit

# %matplotlib inline

# %% [markdown]
# ## The recording
#
# `kitti00` is real: the first seconds of KITTI's drive 00, which comes with the gtsam package. Its ground truth does
# not. If you have it, you will see errors in metres below; if not, the comparison does without.

# %%
truth = real("kitti00/gt_imu.tum")
print("with ground truth" if truth else "without ground truth: it is not on this machine")

# %% [markdown]
# Everything that comes in is a `Sequence`: the calibration, the samples of the IMU, and what the cameras saw.

# %%
sequence = toolkit.load_sequence("kitti00")
print(f"{sequence.frame_count} frames in {sequence.duration_s:.1f} s")
print(f"{sequence.motion.t_ns.size} IMU samples")
print(f"{len(sequence.observations)} stereo sightings of {np.unique(sequence.observations.track_id).size} points")

# %% [markdown]
# A **sighting** is three numbers in pixels: the column of a point in the left image, its column in the right image, and
# the row they share. The difference of the two columns, the disparity, says how far away the point is.

# %%
first = next(sequence.packets())
left_px, right_px, row_px = first.frame.uvs_px[0]
depth_m = sequence.rig.fx_px * sequence.rig.baseline_m / (left_px - right_px)
print(f"columns {left_px:.1f} and {right_px:.1f} px, row {row_px:.1f} px: the point is {depth_m:.1f} m ahead")

# %% [markdown]
# A **packet** is one camera frame with the motion measured since the frame before. Estimators are fed packets, one
# after the other, and every estimator is fed the same ones.
#
# ## The comparison
#
# Three estimators, from the simplest to the best:
#
# - `dead-reckoning` adds up the motion that the IMU measured, and looks at no image;
# - `ekf` is an extended Kalman filter: at each frame it corrects the motion by what the cameras saw;
# - `batch` is a smoother: it waits for the end, then looks for the trajectory that agrees best with everything.

# %%
result = toolkit.compare("kitti00", ["dead-reckoning", "ekf", "batch"], truth=truth)

# %%
result.figures["top_all"]

# %% [markdown]
# Grey dots are the landmarks that the smoother found: house fronts, parked cars, trees. Dead reckoning turns
# too early; the lines of the filter and of the smoother lie on each other, and their differences are in the numbers.
#
# ## How good are they?

# %%
result.table("ATE SE(3)", "reproj held-out", "NIS mean")

# %% [markdown]
# How to read a row:
#
# - **ATE** is the error of the positions in metres, root mean square, after the trajectory was laid over the truth. The
#   columns are there if the truth is.
# - **reproj held-out** needs no truth. One track in ten is hidden from all estimators. Their poses must predict where
#   the cameras saw those points; the number is the median error in pixels. Nobody can win it by fitting harder.
# - **NIS** compares a filter's innovations with those it expected: 1 is consistent, more is overconfident.
#
# `causal` is an estimator's answer at each frame, from the past only; `final` is its answer at the end; `both`
# stands where the two are the same, as with a filter. A smoother has used the future, so the table keeps them apart.

# %% [markdown]
# ## The same with exact truth
#
# `drive-realistic` is a simulation: a car with odometry drives 450 m, and its tracks err as real ones do. Its truth is
# exact, so here the errors are exact, too. Every seed draws another noise; this is seed 0.

# %%
simulated = toolkit.compare("drive-realistic", ["dead-reckoning", "ekf", "batch"])
simulated.table("ATE SE(3)", "reproj held-out", "NEES pose")

# %% [markdown]
# **NEES** compares an estimator's errors with the covariance that it states: 1 is consistent, more is overconfident.
#
# All start from the same pose, and the error is what has drifted since. The legend has its root mean square.

# %%
simulated.figures["errors_over_time"]

# %%
error_m = {name: values["ate_se3_m"] for (name, _), values in simulated.metrics.items()}
print(f"the filter's error is {error_m['ekf'] / error_m['dead-reckoning']:.0%} of dead reckoning's,")
print(f"the smoother's is {error_m['batch'] / error_m['ekf']:.0%} of the filter's")

# %% [markdown]
# Why the smoother wins, step by step, is the subject of [notebook 3](03_why_the_smoother_wins.ipynb).
#
# ## On the command line
#
# All of this is one command in a terminal, which also writes a report with every figure:
#
#     vislam compare kitti00 --out runs/kitti00
#     vislam report runs/kitti00
#
# Next: [what hides in real data](02_the_seed_report.ipynb), and [your own estimator](04_your_own_estimator.ipynb).
