"""The shared models as GTSAM factors: what a filter predicts with is what a smoother's factors contain."""

from collections.abc import Iterator

import gtsam
import numpy as np

from toolkit.geometry import Array
from toolkit.models import twist
from toolkit.models.imu import Preintegration
from toolkit.models.twist import TwistStep
from toolkit.sequence import StereoFrame, StereoRig, TwistNoise

X, V, B, L = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B, gtsam.symbol_shorthand.L)


def kind_of(key: int) -> str:
    """Return what a key names: "x" a pose, "v" a velocity, "b" a bias, "l" a landmark."""
    return chr(gtsam.Symbol(key).chr())


class StereoFactors:
    """Makes one projection factor per sighting: the measurement, noise and extrinsic the filters use."""

    def __init__(self, rig: StereoRig, robust: gtsam.noiseModel.mEstimator.Base | None = None) -> None:
        gaussian = gtsam.noiseModel.Gaussian.Covariance(rig.cov_uv_px2)
        self._noise = gaussian if robust is None else gtsam.noiseModel.Robust.Create(robust, gaussian)
        self._calibration = gtsam.Cal3_S2Stereo(rig.fx_px, rig.fy_px, 0.0, rig.cx_px, rig.cy_px, rig.baseline_m)
        self._T_imu_cam = gtsam.Pose3(rig.T_imu_cam)

    def of(self, frame: StereoFrame, k: int) -> Iterator[gtsam.NonlinearFactor]:
        """Yield the factors between the pose X(k) and the landmarks L(track id) the frame shows."""
        for track_id, uv_px in zip(frame.track_ids.tolist(), frame.uvs_px.tolist(), strict=True):
            measured = gtsam.StereoPoint2(*uv_px)
            yield gtsam.GenericStereoFactor3D(
                measured, self._noise, X(k), L(track_id), self._calibration, self._T_imu_cam
            )


def imu_factor(preintegration: Preintegration, k: int) -> gtsam.NonlinearFactor:
    """Return the factor from frame k - 1 to frame k on poses X, velocities V and biases B."""
    return gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), preintegration)


def twist_factor(step: TwistStep, step_bias: Array, k: int) -> gtsam.NonlinearFactor:
    """Return the factor from pose X(k - 1) and gyro bias B(k - 1) (3,) to pose X(k).

    The residual is the pose error in the tangent of the predicted end, ``log(predicted^-1 T_k)``. ``step``
    was integrated with the bias ``step_bias`` (3,); the change with another bias is first order, as in a
    preintegration.
    """
    predicted, d_step_d_bias = gtsam.Pose3(step.T_start_end), step.d_step_d_bias
    noise = gtsam.noiseModel.Gaussian.Covariance(step.cov)

    def residual(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        start, end, bias_key = this.keys()
        correction = gtsam.Pose3.Expmap(d_step_d_bias @ (values.atVector(bias_key) - step_bias))
        step_now = predicted.compose(correction)
        moved = values.atPose3(start).between(values.atPose3(end))
        error_pose = step_now.between(moved)
        error: Array = gtsam.Pose3.Logmap(error_pose)
        if jacobians is not None:
            d_error_d_end = gtsam.Pose3.LogmapDerivative(error)
            d_error_d_step = -d_error_d_end @ error_pose.inverse().AdjointMap()
            jacobians[0] = d_error_d_step @ step_now.inverse().AdjointMap()
            jacobians[1] = d_error_d_end
            jacobians[2] = d_error_d_step @ d_step_d_bias
        return error

    return gtsam.CustomFactor(noise, [X(k - 1), X(k), B(k - 1)], residual)


def gyro_bias_walk_factor(noise: TwistNoise, dt_s: float, k: int) -> gtsam.NonlinearFactor:
    """Return the random walk of the gyro bias from B(k - 1) to B(k), both (3,)."""
    covariance = gtsam.noiseModel.Gaussian.Covariance(twist.bias_walk_cov(noise, dt_s))
    return gtsam.BetweenFactorVector(B(k - 1), B(k), np.zeros(3), covariance)
