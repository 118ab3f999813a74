"""Tracks that scatter more than the stated noise of a sighting explains: mismatches, or a noise that is too small.

About the camera's own best motion a point triangulated in one frame, of noise R, and projected into the next misses its
sighting there by J R J^T + R, whatever the motion samples say. The upper quartile of that distance is chi-square's with
three degrees of freedom where R is right; the few grossest do not move it. Every estimator is told R and trusts it.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import LEAST_INTERVALS, moved_by
from toolkit.audit.parts.robust import jackknife_error
from toolkit.geometry import Array, se3_inverse, transform
from toolkit.models.camera_motion import CameraMotion, usable_pairs
from toolkit.models.gating import LEAST_DEPTH_M
from toolkit.models.stereo import project, projection_jacobian, triangulate
from toolkit.sequence import Sequence

# Standard deviations over the stated ones. 21 sound simulated recordings have 0.98 to 1.00 and real ones, whose noise
# is assumed, at most 0.62; a tenth of mismatches makes 1.04 to 1.07, three tenths 1.20 to 1.46.
MOST_SCATTER, SIGMAS = 1.05, 5.0
# Distances that a quarter of the sightings exceed, and one in a thousand.
UPPER_QUARTILE, FAR_CHI2 = 4.108, 16.27


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Hold the scatter of the tracks about the camera's own motion against the stated noise."""
    sequence = evidence.sequence
    if evidence.spoilt_by or evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return evidence.blind
    chi2 = own_one_step_chi2(sequence, evidence.camera_motion)
    scatter, error = _scatter(chi2), jackknife_error(_scatter, chi2)
    if scatter < MOST_SCATTER + SIGMAS * error:
        return None
    sigma_px = " ".join(f"{sigma:.2g}" for sigma in np.sqrt(np.diag(sequence.rig.cov_uv_px2)))
    return Symptom(
        count=1,
        detail=(
            f"from frame to frame the tracks scatter {scatter:.2f} +- {error:.2f} times as much as the stated noise of "
            f"a sighting explains (uL uR v: {sigma_px} px); {np.mean(chi2 > FAR_CHI2):.0%} are beyond chance"
        ),
        treatment="mismatches, points that move, or noise stated too small: estimators trust such tracks too much",
        remedy=None,
        harmful=False,
        warns=True,
    )


def own_one_step_chi2(sequence: Sequence, camera: CameraMotion) -> Array:
    """Return the squared Mahalanobis distances (P,) of sightings from what the frame before makes of them, in time.

    Points move by the camera's own motion; only intervals in which that is known.
    """
    pairs, uv_px, rig = usable_pairs(sequence), sequence.observations.uv_px, sequence.rig
    pairs = pairs.select(camera.known[pairs.interval])
    T_after_before = se3_inverse(moved_by(camera, sequence))[pairs.interval]
    before = triangulate(uv_px[pairs.before], rig)
    after = transform(T_after_before, before)
    after[:, 2] = np.maximum(after[:, 2], LEAST_DEPTH_M)
    residual_px = uv_px[pairs.after] - project(after, rig)
    d_after_d_before = T_after_before[:, :3, :3] @ np.linalg.inv(projection_jacobian(before, rig))
    jacobian = projection_jacobian(after, rig) @ d_after_d_before
    cov_px2 = jacobian @ rig.cov_uv_px2 @ jacobian.swapaxes(1, 2) + rig.cov_uv_px2
    return np.asarray((residual_px * np.linalg.solve(cov_px2, residual_px[:, :, None])[..., 0]).sum(axis=1))


def _scatter(chi2: Array) -> float:
    """Return the standard deviation over the stated one that the upper quartile of squared distances (P,) shows."""
    return float(np.sqrt(np.quantile(chi2, 0.75) / UPPER_QUARTILE))


FAULT = Fault(
    "track-scatter",
    "tracks that scatter more than the stated noise explains: mismatches, or a noise that is too small",
    check,
    after=("swapped-coordinates", "no-disparity", "stale-frames", "doubled-disparity", "intrinsics", "units"),
)
