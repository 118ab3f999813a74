"""Absolute trajectory error: how far the estimated positions are from the true ones, under four alignments."""

import numpy as np

from toolkit.geometry import Array
from toolkit.metrics.common.alignment import Alignment, fit_sim3, fit_yaw
from toolkit.metrics.common.judged import Judged
from toolkit.metrics.common.relative import angles_deg, lengths, rmse
from toolkit.metrics.common.scores import Scores, Unavailable, evaluate

ORDER = 10
METRICS = {
    "ate_none_m": "RMSE of position with only the first pose placed, nothing fitted (m)",
    "ate_se3_m": "RMSE of position after fitting rotation and translation (m)",
    "ate_yaw_m": "RMSE of position after fitting heading and translation (m)",
    "ate_sim3_m": "RMSE of position after fitting rotation, translation and scale (m)",
    "ate_se3_deg": "RMSE of the rotation angle after the fit of ate_se3_m (deg)",
}
# A world this far from level (deg), which explains more than half of the squared error of the fit that keeps the
# vertical, is worth a remark; a straight path leaves its roll undetermined and explains nothing by it.
_TILTED_DEG, _EXPLAINED = 1.0, 0.5
_ON_A_LINE = "the positions lie on a line, so the rotation about it is not determined"


def score(judged: Judged) -> Scores:
    """Score the four position errors and the rotation error."""
    scores = evaluate(
        {
            "ate_none_m": lambda: rmse(_distances(judged, judged.placed)),
            "ate_se3_m": lambda: _position_rmse(judged, judged.se3_alignment),
            "ate_yaw_m": lambda: _position_rmse(judged, fit_yaw(*_positions(judged))),
            "ate_sim3_m": lambda: _position_rmse(judged, fit_sim3(*_positions(judged))),
            "ate_se3_deg": lambda: _rotation_rmse_deg(judged),
        }
    )
    if scores.values["ate_se3_m"] is not None and not judged.se3_alignment.rotation_is_unique:
        return scores.remarked(["ate_se3_m", "ate_sim3_m"], _ON_A_LINE)
    return scores.remarked(["ate_none_m", "ate_yaw_m"], _tilt_remark(judged, scores))


def _tilt_remark(judged: Judged, scores: Scores) -> str:
    """Say that the two worlds do not agree on the vertical, where an IMU measures it and it matters; else nothing."""
    se3_m, yaw_m = scores.values["ate_se3_m"], scores.values["ate_yaw_m"]
    if judged.sequence.motion_kind != "imu" or se3_m is None or yaw_m is None:
        return ""
    tilt_deg = float(np.degrees(np.arccos(np.clip(judged.se3_alignment.rotation[2, 2], -1.0, 1.0))))
    if tilt_deg < _TILTED_DEG or se3_m**2 > (1.0 - _EXPLAINED) * yaw_m**2:
        return ""
    return (
        f"the estimate's vertical and the truth's differ by about {tilt_deg:.0f} deg, which is most of this error and "
        "is in end_drift_percent too; if the truth's world is not level, compare ate_se3_m"
    )


def _positions(judged: Judged) -> tuple[Array, Array]:
    return judged.compared.truth[:, :3, 3], judged.compared.estimate[:, :3, 3]


def _distances(judged: Judged, poses: Array) -> Array:
    return lengths(poses[:, :3, 3] - judged.compared.truth[:, :3, 3])


def _position_rmse(judged: Judged, alignment: Alignment) -> float:
    return rmse(_distances(judged, alignment.apply(judged.compared.estimate)))


def _rotation_rmse_deg(judged: Judged) -> float:
    if not judged.se3_alignment.rotation_is_unique:
        raise Unavailable(_ON_A_LINE)
    aligned = judged.se3_alignment.apply(judged.compared.estimate)
    error = np.swapaxes(judged.compared.truth[:, :3, :3], 1, 2) @ aligned[:, :3, :3]
    return rmse(angles_deg(error))
