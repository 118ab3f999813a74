"""From predicted and measured image points to one error an observation, and to the two figures over all of them."""

import numpy as np

from toolkit.geometry import Array, BoolArray
from toolkit.metrics._shared.relative import rmse
from toolkit.metrics._shared.scores import Unavailable

# An observation further off than this is lost, and how far says nothing more. A point behind the camera, or one
# that is not finite, counts as this much: a run must not win by losing its points.
CAP_PX = 100.0


def observation_errors_px(uv_predicted_px: Array, uv_measured_px: Array, in_front: BoolArray) -> Array:
    """Return the root mean square of the uL, uR and v residuals (N,), no more than CAP_PX.

    Predictions and measurements are (N, 3); an observation that is not ``in_front`` (N,) counts as CAP_PX.
    """
    errors_px = np.sqrt(np.mean((uv_measured_px - uv_predicted_px) ** 2, axis=1))
    return np.where(in_front & (errors_px < CAP_PX), errors_px, CAP_PX)


def median_px(errors_px: Array) -> float:
    """Return the median of errors (N,) px; raises Unavailable where there are none."""
    if not errors_px.size:
        raise Unavailable("no observation could be reprojected")
    return float(np.median(errors_px))


def rmse_px(errors_px: Array) -> float:
    """Return the root mean square of errors (N,) px; raises Unavailable where there are none."""
    if not errors_px.size:
        raise Unavailable("no observation could be reprojected")
    return rmse(errors_px)


def remark(errors_px: Array, observation_count: int, why_left_out: str) -> str:
    """Say how many of the observations were scored and how many of those stand at the cap; empty if all is well."""
    parts = []
    if errors_px.size < observation_count:
        parts.append(f"{errors_px.size} of {observation_count} observations scored, the others {why_left_out}")
    at_cap = int(np.count_nonzero(errors_px >= CAP_PX))
    if at_cap:
        parts.append(f"{at_cap} behind the camera or off by more than {CAP_PX:g} px, counted as {CAP_PX:g} px")
    return "; ".join(parts)
