"""Absolute trajectory error: how far the estimated positions are from the true ones, under four alignments."""

from typing import Any

import numpy as np

from toolkit.geometry import Array
from toolkit.metrics.clock_offset import other_point
from toolkit.metrics.parts.evaluation import (
    AgainstTruth,
    Alignment,
    Matched,
    angles_deg,
    fit_sim3,
    fit_yaw,
    lengths,
    rmse,
)
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate

ORDER = 10


def _rmse(key: str, fitted: str, heading: str, **shown: Any) -> Metric:
    return Metric(f"ate_{key}_m", f"RMSE of position {fitted} (m)", "m", ("ATE", heading), **shown)


METRICS = (
    _rmse("none", "with only the first pose placed, nothing fitted", "none", over_seeds=True),
    _rmse("se3", "after fitting rotation and translation", "SE(3)", table="always"),
    _rmse("yaw", "after fitting heading and translation", "yaw", table="always", over_seeds=True),
    _rmse("sim3", "after fitting rotation, translation and scale", "Sim(3)"),
    Metric("ate_se3_deg", "RMSE of the rotation angle after the fit of ate_se3_m (deg)", "deg", ("ATE rot", "SE(3)")),
)
# A remark is made where the estimate's world is tilted by this angle (deg) and the tilt explains more than half of the
# squared error of the fit that keeps the vertical. A smaller tilt is the estimator's own error, or that of a given
# start. A straight path leaves the roll undetermined, which then explains nothing.
_TILTED_DEG, _EXPLAINED = 1.0, 0.5
_DISAGREE = (
    "most of it is a vertical {:.0f} deg off the truth's; if the truth's world is not level, compare ATE SE(3) instead"
)
_UNMEASURED = "most of it is the tilt of the first frame, which nothing measured; compare ATE SE(3) instead"
# A remark is made where the scale is wrong by this share, and positions fit this many times as well with another one.
_LEAST_SCALE, _TIMES_BETTER = 0.02, 3.0
_LENGTHS = {"feet": 0.3048, "yards": 0.9144, "inches": 0.0254, "miles": 1609.344, "kilometres": 1000.0}
_SCALED = "its positions fit to {:.3g} m when multiplied by {:.4g}{}: check units, baseline, focal length and wheels"
_ON_A_LINE = "the positions lie on a line or in a point, so the rotation about it is not determined"


def score(evaluation: AgainstTruth) -> Scores:
    scores = evaluate(
        {
            "ate_none_m": lambda: rmse(_distances(evaluation.compared, evaluation.placed)),
            "ate_se3_m": lambda: position_rmse(evaluation.compared, evaluation.se3_alignment),
            "ate_yaw_m": lambda: position_rmse(evaluation.compared, fit_yaw(*evaluation.compared.positions)),
            "ate_sim3_m": lambda: position_rmse(evaluation.compared, fit_sim3(*evaluation.compared.positions)),
            "ate_se3_deg": lambda: rotation_rmse_deg(evaluation.oriented, evaluation.se3_alignment),
        }
    )
    if scores.values["ate_se3_m"] is not None and not evaluation.se3_alignment.rotation_is_unique:
        return scores.remarked(["ate_se3_m", "ate_sim3_m"], _ON_A_LINE)
    if (scale := _telling_scale(evaluation, scores)) is not None:
        unit = "".join(f", as if in {name}" for name, metres in _LENGTHS.items() if abs(scale / metres - 1.0) < 0.02)
        return scores.remarked(["ate_se3_m", "ate_yaw_m"], _SCALED.format(scores.values["ate_sim3_m"], scale, unit))
    if scores.values["ate_se3_m"] is not None and (point := other_point(evaluation)) is not None:
        return scores.remarked(["ate_se3_m", "ate_yaw_m"], point)
    tilt_deg = _telling_tilt_deg(evaluation, scores)
    if tilt_deg is None:
        return scores
    if evaluation.level:
        return scores.remarked(["ate_none_m", "ate_yaw_m"], _DISAGREE.format(tilt_deg))
    return scores.remarked(["ate_yaw_m"], _UNMEASURED)


def _telling_tilt_deg(evaluation: AgainstTruth, scores: Scores) -> float | None:
    """Return the angle between the two verticals (deg) if it explains most of ate_yaw_m, else None."""
    se3_m, yaw_m = scores.values["ate_se3_m"], scores.values["ate_yaw_m"]
    if se3_m is None or yaw_m is None or se3_m**2 > (1.0 - _EXPLAINED) * yaw_m**2:
        return None
    tilt_deg = float(np.degrees(np.arccos(np.clip(evaluation.se3_alignment.rotation[2, 2], -1.0, 1.0))))
    return tilt_deg if tilt_deg >= _TILTED_DEG else None


def _telling_scale(evaluation: AgainstTruth, scores: Scores) -> float | None:
    """Return the factor on the estimate's scale that explains nearly all of ate_se3_m, else None."""
    se3_m, sim3_m = scores.values["ate_se3_m"], scores.values["ate_sim3_m"]
    if se3_m is None or sim3_m is None or _TIMES_BETTER * sim3_m > se3_m:
        return None
    scale = fit_sim3(*evaluation.compared.positions).scale
    return scale if abs(scale - 1.0) > _LEAST_SCALE else None


def _distances(matched: Matched, poses: Array) -> Array:
    return lengths(poses[:, :3, 3] - matched.truth[:, :3, 3])


def position_rmse(matched: Matched, alignment: Alignment) -> float:
    """Return the root mean square of the distances between true and aligned positions, in metres."""
    return rmse(_distances(matched, alignment.apply(matched.estimate)))


def rotation_rmse_deg(matched: Matched, alignment: Alignment) -> float:
    """Return the RMSE of the rotation angles (deg); raise Unavailable where the alignment leaves them open."""
    if not alignment.rotation_is_unique:
        raise Unavailable(_ON_A_LINE)
    aligned = alignment.apply(matched.estimate)
    error = np.swapaxes(matched.truth[:, :3, :3], 1, 2) @ aligned[:, :3, :3]
    return rmse(angles_deg(error))
