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
    return scores


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
