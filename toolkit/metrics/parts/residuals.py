"""The error of each pair of poses or of image points, and statistics over all of them."""

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, so3_log
from toolkit.measurements import is_left_only
from toolkit.metrics.parts.association import Matched
from toolkit.metrics.parts.scores import InTable, Metric, Scores, Unavailable

# Cap of the error of an observation. A point behind the camera, or one that is not finite, has this error, so that no
# run gains by losing its points.
CAP_PX = 100.0


def relative_errors(matched: Matched, first: IntArray, last: IntArray) -> Array:
    """Return E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) (p, 4, 4) for true poses Q, estimates P and index pairs (p,), (p,).

    Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), eq. 2. Free of any gauge.
    """
    true_motion = se3_inverse(matched.truth[first]) @ matched.truth[last]
    estimated_motion = se3_inverse(matched.estimate[first]) @ matched.estimate[last]
    return se3_inverse(true_motion) @ estimated_motion


def lengths(vectors: Array) -> Array:
    """Return the Euclidean length (...,) of vectors (..., 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def angles_deg(rotations: Array) -> Array:
    """Return the rotation angle (...,) in degrees, 0 to 180, of rotations (..., 3, 3)."""
    return np.degrees(lengths(so3_log(rotations)))


def rmse(errors: Array) -> float:
    """Return the root mean square of errors (N,)."""
    return float(np.sqrt(np.mean(errors**2)))


def reprojection_errors_px(uv_predicted_px: Array, uv_measured_px: Array, in_front: BoolArray) -> Array:
    """Return the root mean square of the uL, uR and v residuals (N,), no more than CAP_PX.

    Predictions and measurements are (N, 3); an observation that is not ``in_front`` (N,) counts as CAP_PX. One that
    lacks the right image has the root mean square of uL and v.
    """
    squares_px2 = (uv_measured_px - uv_predicted_px) ** 2
    means_px2 = np.where(is_left_only(uv_measured_px), squares_px2[:, [0, 2]].mean(axis=1), squares_px2.mean(axis=1))
    errors_px = np.sqrt(means_px2)
    return np.where(in_front & (errors_px < CAP_PX), errors_px, CAP_PX)


def pixel_metrics(
    prefix: str,
    error: str,
    whose: str,
    heading: tuple[str, str],
    *,
    table: InTable = "on request",
    over_seeds: bool = False,
    gate_name: str = "",
) -> tuple[Metric, Metric]:
    """Declare PREFIX_median_px and PREFIX_rmse_px of an error (N,) px, which :func:`pixel_scores` scores.

    ``whose`` is a word that distinguishes it from other reprojection errors; the other arguments say how the median is
    shown (:class:`Metric`).
    """
    median = Metric(
        f"{prefix}_median_px",
        f"median {error} (px)",
        "px",
        heading,
        name=f"reproj {whose}",
        table=table,
        over_seeds=over_seeds,
        in_contract=True,
        gate_name=gate_name,
    )
    capped = f"RMSE of the same, each observation's error capped at {CAP_PX:g} px (px)"
    name = f"reproj {whose} RMSE"
    return median, Metric(f"{prefix}_rmse_px", capped, "px", (whose, "RMSE"), name=name, in_contract=True)


def pixel_scores(prefix: str, errors_px: Array, observation_count: int, why_left_out: str) -> Scores:
    """Score the median and the root mean square of errors (N,) px, as the metrics PREFIX_median_px and PREFIX_rmse_px.

    A remark says how many of the observations were scored, why others were not, and how many of the scored ones are at
    the cap. Raises Unavailable where there are none.
    """
    if not errors_px.size:
        raise Unavailable("no observation could be reprojected")
    parts = []
    if errors_px.size < observation_count:
        parts.append(f"{errors_px.size} of {observation_count} observations scored, the others {why_left_out}")
    at_cap = int(np.count_nonzero(errors_px >= CAP_PX))
    if at_cap:
        parts.append(f"{at_cap} behind the camera or off by more than {CAP_PX:g} px, counted as {CAP_PX:g} px")
    scores = Scores({f"{prefix}_median_px": float(np.median(errors_px)), f"{prefix}_rmse_px": rmse(errors_px)})
    return scores.remarked(scores.values, "; ".join(parts))
