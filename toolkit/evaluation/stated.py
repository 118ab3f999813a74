"""NEES of a file that states two covariances for each pose, of its orientation and of its position.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4. The error
of an orientation is a turn of the body frame, that of a position is in the estimate's world, as OpenVINS states them.
"""

import numpy as np

from toolkit.datasets.trajectories.poses import PosesFile, StatedApart
from toolkit.gate.trajectory_files import Poses
from toolkit.geometry import Array, se3_inverse, so3_log
from toolkit.metrics import Scores, Unavailable
from toolkit.metrics._shared.alignment import place_pose, place_yaw
from toolkit.metrics._shared.association import median_period_ns, poses_at
from toolkit.metrics._shared.consistency import (
    NOT_MET,
    NOT_PLACED,
    OTHER_WORLD,
    PLACED,
    chi2_quantile,
)
from toolkit.models.gating import mahalanobis_squared

_KEYS = ("nees_ori_mean", "nees_pos_mean")
_NONE = "the file states no covariance"


def nees_scores(file: PosesFile, estimate: Poses, truth: Poses, *, level: bool) -> Scores:
    """Return the mean NEES of orientation and position over their 3 degrees of freedom, None with the reason.

    In the truth's world where the first pose is plausible there under its own covariances; else it is placed on the
    truth's, its heading and position alone where the vertical is measured (``level``).
    """
    try:
        return _scores(file.covariances, estimate, truth, level=level)
    except Unavailable as reason:
        return Scores.none(_KEYS, str(reason))


def _scores(stated: StatedApart | None, estimate: Poses, truth: Poses, *, level: bool) -> Scores:
    if stated is None:
        raise Unavailable(_NONE)
    met, true = poses_at(truth.t_ns, truth.poses, estimate.t_ns, median_period_ns(truth.t_ns))
    if not met.any():
        raise Unavailable(NOT_MET)
    poses, covs = estimate.poses[met], (stated.orientation[met], stated.position[met])
    bad = sum(int((~np.isfinite(cov).all(axis=(1, 2)) | (_least_eigenvalue(cov) <= 0.0)).sum()) for cov in covs)
    if bad:
        raise Unavailable(f"{bad} of {2 * len(poses)} covariances are not positive definite")
    first = _nees(true[:1], poses[:1], covs[0][:1], covs[1][:1])
    placed = max(float(one[0]) for one in first) > chi2_quantile(1.0 - OTHER_WORLD, 3) / 3.0
    if placed:
        if not met[0]:
            raise Unavailable(NOT_PLACED)
        # The truth moves into the estimate's world, in which the covariances are stated.
        true = (place_yaw if level else place_pose)(poses[0], true[0]).apply(true)
    orientation, position = _nees(true, poses, *covs)
    scores = Scores(dict(zip(_KEYS, (float(orientation.mean()), float(position.mean())), strict=True)))
    return scores.remarked(_KEYS, PLACED if placed else "")


def _nees(true: Array, poses: Array, cov_orientation: Array, cov_position: Array) -> tuple[Array, Array]:
    turned = so3_log((se3_inverse(poses) @ true)[:, :3, :3])
    moved = true[:, :3, 3] - poses[:, :3, 3]
    return mahalanobis_squared(turned, cov_orientation) / 3.0, mahalanobis_squared(moved, cov_position) / 3.0


def _least_eigenvalue(cov: Array) -> Array:
    finite = np.where(np.isfinite(cov), cov, 0.0)
    return np.asarray(np.linalg.eigvalsh(finite)[:, 0])
