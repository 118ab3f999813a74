"""Finds estimators whose trajectory contradicts the measured motion, which no single run of them can show.

Wheel slip or a wrong start show where an estimator that corrects the measured motion by vision differs from one that
uses it alone by more than the covariances of both allow. The covariance of the difference is assumed to be the sum of
both; it is at most that, because estimators of the same motion from the same start share errors, which are then not
negatively correlated. A difference of two estimates shows that one of them is inconsistent, not which (Hausman 1978,
"Specification tests in econometrics").
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Row
from toolkit.geometry import se3_inverse, se3_log
from toolkit.measurements import NS_PER_S
from toolkit.metrics.correction_trend import NOTHING_CORRECTED, TREND
from toolkit.models.gating import mahalanobis_squared
from toolkit.models.state import POSE, POSITION, ROTATION

# Squared distance of two consistent estimates of a pose, over its degrees of freedom, that is exceeded once in a
# million.
FARTHEST = float(chdtri(6, 1e-6)) / 6.0
# Rounding of poses that are known exactly, as the first one may be: m and rad.
_ROUNDING = 1e-6


class FarthestPose(NamedTuple):
    """The largest distance of a row from the measured motion alone: time (s), distance, squared Mahalanobis distance.

    ``squared`` is divided by its 6 degrees of freedom: 1 on average where both are consistent and independent.
    """

    row: Row
    t_s: float
    distance_m: float
    angle_deg: float
    squared: float


def too_far(rows: Iterable[Row]) -> tuple[FarthestPose, ...]:
    """Return the rows that are farther from one that corrects nothing than chance allows; none over seeds.

    Over seeds no runs are kept.
    """
    rows = [row for row in rows if row.answered]
    uncorrected = [row for row in rows if row.value(TREND) is None and row.reason(TREND) == NOTHING_CORRECTED]
    motion = _trajectory(uncorrected[0]) if uncorrected else None
    if motion is None:
        return ()
    names = {row.estimator for row in uncorrected}
    apart = (farthest(row, motion) for row in rows if row.estimator not in names)
    return tuple(one for one in apart if one is not None and one.squared > FARTHEST)


def farthest(row: Row, motion: Trajectory) -> FarthestPose | None:
    """Return the largest Mahalanobis distance of a row from a trajectory, or None where a covariance is lacking."""
    other = _trajectory(row)
    if other is None or other.cov is None or motion.cov is None:
        return None
    _, mine, its = np.intersect1d(motion.t_ns, other.t_ns, assume_unique=True, return_indices=True)
    cov = motion.cov[mine][:, POSE, POSE] + other.cov[its][:, POSE, POSE] + _ROUNDING**2 * np.eye(6)
    apart = se3_log(se3_inverse(motion.T_world_imu[mine]) @ other.T_world_imu[its])
    known = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(apart).all(axis=1)
    if not known.any():
        return None
    squared = mahalanobis_squared(apart[known], cov[known])
    k = int(np.argmax(squared))
    t_s = (motion.t_ns[mine][known][k] - motion.t_ns[0]) / NS_PER_S
    distance_m, angle = np.linalg.norm(apart[known][k, POSITION]), np.linalg.norm(apart[known][k, ROTATION])
    return FarthestPose(row, float(t_s), float(distance_m), float(np.degrees(angle)), float(squared[k]) / 6.0)


def _trajectory(row: Row) -> Trajectory | None:
    run = row.outcomes[0].run
    return None if run is None or len(row.outcomes) > 1 else run.trajectory(row.output)
