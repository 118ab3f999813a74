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
# # 4. Write your own estimator
#
# Thirty lines are enough for an estimator with vision. We write one, compare it with the others, test whether it states
# its own error, make a file of it, and let the gate guard it. All of this runs on simulated data, which are built in.

# %%
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from IPython import get_ipython

from toolkit import compare, load_sequence
from toolkit.answers import Run
from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Setup
from toolkit.gate.baseline import Case
from toolkit.gate.checking import CheckTerms, check, new_baseline
from toolkit.geometry import Array, se3_adjoint, se3_exp, se3_inverse
from toolkit.measurements import Packet, StereoFrame
from toolkit.metrics import score_run
from toolkit.models import stereo, twist
from toolkit.progress import SILENT, silent
from toolkit.report.gate import gate_text, verification_text
from toolkit.runner import run
from toolkit.verify import subject_of, verify

# %matplotlib inline

# %% [markdown]
# ## The idea
#
# Between two frames the car moves a little. The velocities measure how, with noise. The cameras measure it, too: the
# points they measured in the last frame must appear in this frame where the motion puts them. We weigh the two by their
# covariances. That is one step of a Kalman filter, for the motion between two frames.
#
# What an estimator needs to be: `build(setup)` makes one, `step(packet)` answers for a frame from the past alone, and
# `finish()` answers for all frames at the end. `setup` has the calibration, the noise and the start.


# %%
class TwoView:
    """Dead reckoning whose every step is corrected by the points of the frame before."""

    GATE = 7.81  # 95 % of chi-square with 3 degrees of freedom: a sighting beyond it is a mismatch

    def __init__(self, setup: Setup) -> None:
        if setup.motion_kind != "twist":
            raise EstimatorError("it needs measured velocities, and the recording has IMU samples")
        self.setup, self.said, self.points_imu = setup, [], {}
        self.T_world_imu, self.cov = setup.prior.T_world_imu, setup.prior.cov[:6, :6]

    def step(self, packet: Packet) -> Estimate:
        """Move, correct the move, and remember the points that are seen now."""
        if packet.motion is not None:
            move = twist.integrate(packet.motion, self.setup.prior.bias[3:], self.setup.noise)
            T_before_now, cov = self.corrected(move.T_start_end, move.cov, packet.frame)
            carry = se3_adjoint(se3_inverse(T_before_now))
            self.T_world_imu, self.cov = self.T_world_imu @ T_before_now, carry @ self.cov @ carry.T + cov
        near = packet.frame.uvs_px[:, 0] - packet.frame.uvs_px[:, 1] > 1.0
        points = stereo.triangulate_world(packet.frame.uvs_px[near], np.eye(4), self.setup.rig)
        self.points_imu = dict(zip(packet.frame.track_ids[near].tolist(), points, strict=True))
        self.said.append(Estimate(packet.frame.t_ns, self.T_world_imu, self.cov))
        return self.said[-1]

    def corrected(self, T_before_now: Array, cov: Array, frame: StereoFrame) -> tuple[Array, Array]:
        """Return the move and its covariance, corrected by the points seen before and now."""
        rows = [row for row, track in enumerate(frame.track_ids.tolist()) if track in self.points_imu]
        points = np.array([self.points_imu[track] for track in frame.track_ids[rows].tolist()]).reshape(-1, 3)
        predicted = stereo.predict(points, T_before_now, self.setup.rig)
        residual_px, H = frame.uvs_px[rows] - predicted.uv_px, predicted.d_uv_d_pose
        weight = np.linalg.inv(2.0 * self.setup.rig.cov_uv_px2)  # twice: both sightings are noisy
        S = H @ cov @ H.transpose(0, 2, 1) + 2.0 * self.setup.rig.cov_uv_px2
        distance = np.einsum("ni,nij,nj->n", residual_px, np.linalg.inv(S), residual_px)
        good = (distance < self.GATE) & (predicted.depth_m > 0.0)
        information = np.linalg.inv(cov) + np.einsum("nij,ik,nkl->jl", H[good], weight, H[good])
        xi = np.linalg.solve(information, np.einsum("nij,ik,nk->j", H[good], weight, residual_px[good]))
        return T_before_now @ se3_exp(xi), np.linalg.inv(information)

    def finish(self) -> Finished:
        """Say again what was said at every frame."""
        return Finished(Trajectory.of(self.said), Landmarks.none())


def build(setup: Setup) -> TwoView:
    """Return the estimator for one sequence."""
    return TwoView(setup)


# %% [markdown]
# The residuals and their derivatives come from `toolkit.models`, which all estimators share. `H` is the derivative of
# (uL, uR, v) with respect to the pose; its sign and order are in the [conventions](../docs/conventions.md).
#
# ## Does it run?
#
# The runner feeds it packets; `score_run` judges the run.

# %%
drive = load_sequence("drive").truncated(200)
mine: Run = run("two-view", build, drive, drive.prior, SILENT)
scores = score_run(mine, "final", drive)
print(f"{mine.status}: position error {scores.values['ate_se3_m']:.2f} m over {drive.duration_s:.0f} s")

# %% [markdown]
# ## Is it any good?
#
# Beside the others, on the same packets. `own=` takes estimators that live in a notebook.

# %%
result = compare("drive", ["dead-reckoning", "ekf"], own={"two-view": build})
result.table("ATE SE(3)", "RPE 100 m", "reproj held-out")

# %%
result.figures["errors_over_time"]

# %% [markdown]
# It uses each point for two frames only, and forgets it. Whatever the error of one step is, the next step starts from
# it: this is dead reckoning still, with better steps. The filter follows a point for as long as it is seen.
#
# ## A file of its own
#
# To run over many seeds in other processes, and from the command line, an estimator has to be a file. It need not be
# installed: `vislam compare drive --estimators ekf,two_view.py` runs it beside the others, and `vislam verify
# two_view.py` checks what every estimator promises, as here. In this repository it would go into `filters/`.

# %%
IMPORTS = '''"""Dead reckoning whose every step is corrected by the points of the frame before."""

import numpy as np

from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Setup
from toolkit.geometry import Array, se3_adjoint, se3_exp, se3_inverse
from toolkit.measurements import Packet, StereoFrame
from toolkit.models import stereo, twist


'''
cell = next(c for c in reversed(get_ipython().user_ns["In"]) if c.startswith("class TwoView"))  # the one above
here, folder = Path.cwd(), TemporaryDirectory()
os.chdir(folder.name)
file = Path("two_view.py")
file.write_text(IMPORTS + cell)
print(verification_text(verify(subject_of("two_view.py"), "two_view.py")))

# %% [markdown]
# ## Does it know its own error?
#
# Now it can run in other processes, over many seeds. The NEES is the squared error over the covariance that the
# estimator states: 1 is consistent, more is overconfident (see [notebook 3](03_why_the_smoother_wins.ipynb)).

# %%
over = compare("drive", ["dead-reckoning", "ekf", "two_view.py"], seeds=4, max_frames=25)
over.table("ATE none", "NEES rot", "NEES pos", "NEES pose")

# %%
over.figures["nees_over_seeds"]

# %%
nees = {name: values["nees_pose_mean"] for (name, _), values in over.metrics.items()}
print(f"two-view states an error of which the true one is {np.sqrt(nees['two-view']):.1f} times as large,")
print(f"ekf one of which it is {np.sqrt(nees['ekf']):.1f} times as large")

# %% [markdown]
# ## The gate
#
# The estimator works. How do we keep it so? A **baseline** stores what it reaches under every seed, and a **check**
# measures again and compares seed by seed. (`vislam baseline` and `vislam check` do this from the command line and in
# continuous integration; see the [page on the gate](../docs/gate.md).)


# %%
case = Case("drive", simulated=True, seeds=tuple(range(6)), estimators=("two_view.py",), duration_s=3.0)
baseline = new_baseline([case], workers=1, made_by={}, progress_for=silent)


def check_again() -> str:
    """Measure everything in the baseline again, and return what the gate says; time is not judged here."""
    return gate_text(check(baseline, "the baseline", 1, silent, CheckTerms(speed=False)))


print(check_again())

# %% [markdown]
# Nothing changed, so nothing got worse. Now somebody finds that the code is simpler without the gate on mismatches.

# %%
file.write_text(file.read_text().replace("GATE = 7.81", "GATE = np.inf"))
print(check_again())

# %% [markdown]
# The check fails and says what for. `vislam check` would end with status 1, and the change would not be merged.

# %%
os.chdir(here)
folder.cleanup()

# %% [markdown]
# ## Your turn
#
# - It does not estimate the gyro's bias. `twist.integrate` returns the derivative of a step with respect to it.
# - A point that was seen in three frames says more than in two.
# - Both sightings of a point are counted twice, once as *now* and once as *before*. Does the NEES show it?
#
# [Extending](../docs/extending.md) has the rules for a file in this repository, and the same for datasets and metrics.
