"""seed-ekf against the report's equations 1 to 14, written out slowly: four-row measurements, twists [v; w].

The report leaves open what W and the first covariances are: W is the noise of the measured twist carried to the end
of the step, a landmark starts with its first measurement's noise carried through the triangulation.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from tests.filters.conftest import assert_covariances_agree
from toolkit.geometry import Array
from toolkit.initialization import GYRO_BIAS_SIGMA
from toolkit.measurements import StereoFrame, StereoRig, TwistMotion, TwistNoise
from toolkit.models import twist
from toolkit.simulation import DRIVE, simulate

SIGMA_PX = 1.0
V = SIGMA_PX**2 * np.eye(4)
P_T = np.vstack([np.eye(3), np.zeros((1, 3))])
# From the order [v; w] of the report to GTSAM's [rotation, position].
TO_GTSAM = np.r_[3:6, 0:3]


def hat(w: Array) -> Array:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def twist_hat(xi: Array) -> Array:
    result = np.zeros((4, 4))
    result[:3, :3], result[:3, 3] = hat(xi[3:]), xi[:3]
    return result


def curly_hat(xi: Array) -> Array:
    return np.block([[hat(xi[3:]), hat(xi[:3])], [np.zeros((3, 3)), hat(xi[3:])]])


def circle_dot(point: Array) -> Array:
    return np.vstack([np.hstack([np.eye(3), -hat(point[:3])]), np.zeros((1, 6))])


def d_projection(q: Array) -> Array:
    """d pi / d q of pi(q) = q / q_3."""
    result = np.eye(4)
    result[:, 2] -= q / q[2]
    result[2, 2] = 0.0
    return result / q[2]


class Report:
    """The report's filter for one frame after another; the map is a dictionary of points and covariances."""

    def __init__(self, rig: StereoRig, noise: TwistNoise, T: Array, cov: Array) -> None:
        self.T, self.cov, self.noise = T, cov, noise
        self.T_io = rig.T_imu_cam
        fx, fy, cx, cy = rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px
        self.K_s = np.array(
            [[fx, 0, cx, 0], [0, fy, cy, 0], [fx, 0, cx, -fx * rig.baseline_m], [0, fy, cy, 0]], dtype=float
        )
        self.map: dict[int, tuple[Array, Array]] = {}

    def frame(self, motion: TwistMotion | None, frame: StereoFrame) -> None:
        if motion is not None:
            self.predict(motion)
        z = {int(i): uv[[0, 2, 1, 2]] for i, uv in zip(frame.track_ids, frame.uvs_px, strict=True)}
        self.map = {i: landmark for i, landmark in self.map.items() if i in z}
        seen_again = sorted(self.map)
        for i in seen_again:
            self.update_landmark(i, z[i])
        if seen_again:
            self.update_pose(seen_again, z)
        for i in z.keys() - set(seen_again):
            self.start_landmark(i, z[i])

    def predict(self, motion: TwistMotion) -> None:
        (tau,), (v,), (w,) = motion.dt_s, motion.v_mps, motion.w_radps
        xi = np.concatenate([v, w])
        noise_w = twist.integrate(motion, np.zeros(3), self.noise).cov[np.ix_(TO_GTSAM, TO_GTSAM)]
        carry = expm(-tau * curly_hat(xi))
        self.T = self.T @ expm(tau * twist_hat(xi))  # (1)
        self.cov = carry @ self.cov @ carry.T + noise_w  # (2)

    def start_landmark(self, i: int, z: Array) -> None:
        depth = -self.K_s[2, 3] / (z[0] - z[2])
        x_o = (z[0] - self.K_s[0, 2]) * depth / self.K_s[0, 0]
        y_o = (z[1] - self.K_s[1, 2]) * depth / self.K_s[1, 1]
        m = (self.T @ self.T_io @ np.array([x_o, y_o, depth, 1.0]))[:3]  # (4), (5)
        H = self.d_z_d_m(m)
        self.map[i] = m, np.linalg.inv(H.T @ np.linalg.inv(V) @ H)

    def in_camera(self, m: Array) -> Array:
        q: Array = np.linalg.inv(self.T_io) @ np.linalg.inv(self.T) @ np.append(m, 1.0)
        return q

    def z_predicted(self, m: Array) -> Array:
        q = self.in_camera(m)
        z: Array = self.K_s @ (q / q[2])  # (6)
        return z

    def d_z_d_m(self, m: Array) -> Array:
        outer = np.linalg.inv(self.T_io) @ np.linalg.inv(self.T) @ P_T
        return self.K_s @ d_projection(self.in_camera(m)) @ outer  # (7)

    def d_z_d_pose(self, m: Array) -> Array:
        point = np.linalg.inv(self.T) @ np.append(m, 1.0)
        return -self.K_s @ d_projection(self.in_camera(m)) @ np.linalg.inv(self.T_io) @ circle_dot(point)  # (11)

    def update_landmark(self, i: int, z: Array) -> None:
        m, cov_m = self.map[i]
        H = self.d_z_d_m(m)
        K = cov_m @ H.T @ np.linalg.inv(H @ cov_m @ H.T + V)  # (8)
        self.map[i] = m + K @ (z - self.z_predicted(m)), (np.eye(3) - K @ H) @ cov_m  # (9), (10)

    def update_pose(self, ids: list[int], z: dict[int, Array]) -> None:
        H = np.vstack([self.d_z_d_pose(self.map[i][0]) for i in ids])
        innovation = np.concatenate([z[i] - self.z_predicted(self.map[i][0]) for i in ids])
        K = self.cov @ H.T @ np.linalg.inv(H @ self.cov @ H.T + SIGMA_PX**2 * np.eye(len(H)))  # (12)
        self.T = self.T @ expm(twist_hat(K @ innovation))  # (13)
        self.cov = (np.eye(6) - K @ H) @ self.cov  # (14)


def test_it_is_the_report_to_the_letter_from_the_start_of_a_real_recording(run_estimator):
    """The report has no gyro bias: that a recording's start thinks it unknown to 0.02 rad/s must change nothing."""
    drive = simulate(replace(DRIVE, duration_s=1.5), 0)
    cov, to_report = drive.prior.cov.copy(), np.argsort(TO_GTSAM)
    cov[12:, 12:] = GYRO_BIAS_SIGMA**2 * np.eye(3)
    run = run_estimator("seed-ekf", drive, replace(drive.prior, cov=cov))
    report = Report(drive.rig, drive.noise, drive.prior.T_world_imu, cov[np.ix_(to_report, to_report)])
    for k, packet in enumerate(drive.packets()):
        report.frame(packet.motion, packet.frame)
        # A thousand times what the two orders of the same products differ by.
        np.testing.assert_allclose(run.causal.T_world_imu[k], report.T, atol=1e-9)
        assert_covariances_agree(run.causal.cov[k][:6, :6], report.cov[np.ix_(TO_GTSAM, TO_GTSAM)], 1e-9)
