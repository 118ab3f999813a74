# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 5. The course's three steps, as exercises
#
# The report this project grew out of (Kang & Atanasov, "Visual-Inertial SLAM via Extended Kalman Filter") has three
# steps: predict the pose from velocities (III-A), map landmarks along it (III-B), let the landmarks correct the pose
# (III-C). Here you write each of them in a few lines of NumPy.
#
# Every exercise ends with a check against something that was written by somebody else: a numerical derivative, GTSAM,
# or the toolkit's own estimator. Write your version before you read the one below it, then put yours in its place: the
# checks do not mind how you did it.

# %%
import gtsam
import matplotlib.pyplot as plt
import numpy as np

import toolkit
from toolkit.datasets import load_sequence
from toolkit.measurements import Packet
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX

# %matplotlib inline
plt.rcParams |= {"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True, "grid.alpha": 0.3}

# %% [markdown]
# ## The measurements
#
# A simulated car, ten seconds long: its truth is known, so that you can see how well you do. A **packet** is one frame
# of the cameras with the velocities measured since the frame before. Estimators get packets, and so do you.

# %%
FRAMES = 100
sequence = load_sequence("drive").truncated(FRAMES)
packets = list(sequence.packets())
rig, noise, prior = sequence.rig, sequence.noise, sequence.prior

motion = packets[1].motion
print(f"{len(packets)} packets; the motion into the second:")
print(f"  for {motion.dt_s[0]:.2f} s at {motion.v_mps[0].round(2)} m/s, turning at {motion.w_radps[0].round(3)} rad/s")
seen = packets[1].frame
print(f"the frame shows {len(seen.track_ids)} points; the first at (uL, uR, v) = {seen.uvs_px[0]}")

# %% [markdown]
# The toolkit estimates once, so that there is something to compare with. No gate and no robust loss
# (`outliers: none`): the report has neither.

# %%
names = ["dead-reckoning", "mapping", "seed-ekf", "ekf", "batch"]
oracle = toolkit.compare(sequence, names, settings={"outliers": {"policy": "none"}})


def largest_m(poses: np.ndarray, estimator: str) -> float:
    """Return how far positions (K, 3) of poses (K, 4, 4) are from an estimator's, at most."""
    return float(np.linalg.norm(poses[:, :3, 3] - oracle.runs[estimator].final.positions, axis=1).max())


# %% [markdown]
# ## III-A. Predict the pose
#
# A pose moves with the body's angular velocity $\omega$ and velocity $v$ (eqs. 1 and 2 of the report, in the order
# rotation, position that GTSAM and this project have):
#
# $$T_{t+1} = T_t \exp(\tau \hat\xi), \qquad \Sigma_{t+1} = F \Sigma_t F^\top + W, \qquad
# \xi = \begin{pmatrix} \omega \\ v \end{pmatrix}, \quad F = \mathrm{Ad}_{\exp(-\tau \hat\xi)}$$
#
# **Exercise 1.** Write the exponential map of SE(3) and the adjoint. For a rotation vector $\phi$ of length $\theta$,
#
# $$\exp(\hat\phi) = I + \tfrac{\sin\theta}{\theta}\hat\phi + \tfrac{1-\cos\theta}{\theta^2}\hat\phi^2, \qquad
# V = I + \tfrac{1-\cos\theta}{\theta^2}\hat\phi + \tfrac{\theta-\sin\theta}{\theta^3}\hat\phi^2,$$
#
# and the translation of $\exp(\hat\xi)$ is $V\rho$ for $\xi = (\phi, \rho)$. Mind $\theta = 0$.


# %%
def hat(a: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) with hat(a) @ b = a x b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def exp_se3(xi: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) that a twist (6,) [rotation, position] reaches in unit time."""
    phi, rho = xi[:3], xi[3:]
    angle, turn = np.linalg.norm(phi), hat(phi)
    if angle < 1e-4:  # the first terms of the series; the next are below rounding
        a, b, c = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    else:
        a, b, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    T = np.eye(4)
    T[:3, :3] += a * turn + b * turn @ turn
    T[:3, 3] = (np.eye(3) + b * turn + c * turn @ turn) @ rho
    return T


def inverse(T: np.ndarray) -> np.ndarray:
    """Return the inverse of a pose (4, 4)."""
    back = T[:3, :3].T
    return np.block([[back, -back @ T[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])


def adjoint(T: np.ndarray) -> np.ndarray:
    """Return Ad_T (6, 6): T exp(xi) = exp(Ad_T xi) T."""
    turned = T[:3, :3]
    return np.block([[turned, np.zeros((3, 3))], [hat(T[:3, 3]) @ turned, turned]])


# %% [markdown]
# The check is GTSAM, at random twists and at tiny ones.

# %%
rng = np.random.default_rng(5)
for size in (2.0, 1e-3, 1e-9, 0.0):
    xi = size * rng.standard_normal(6)
    theirs = gtsam.Pose3.Expmap(xi)
    assert np.allclose(exp_se3(xi), theirs.matrix(), atol=1e-12)
    assert np.allclose(adjoint(exp_se3(xi)), theirs.AdjointMap(), atol=1e-12)
print("the exponential map and the adjoint are GTSAM's")

# %% [markdown]
# **Exercise 2.** Predict the whole trajectory. The noise of a sample is white with a density: held for $\tau$ seconds,
# the twist $\tau\xi$ has the covariance $\tau\,\mathrm{diag}(\sigma_\omega^2, \sigma_v^2)$. To first order that is $W$.


# %%
def predict(T: np.ndarray, cov: np.ndarray, packet: Packet) -> tuple[np.ndarray, np.ndarray]:
    """Carry a pose (4, 4) and its covariance (6, 6) over the motion of a packet."""
    if packet.motion is None:  # nothing was measured before the first frame
        return T, cov
    density = np.concatenate([noise.gyro_noise_density, noise.velocity_noise_density])
    for dt_s, v_mps, w_radps in zip(packet.motion.dt_s, packet.motion.v_mps, packet.motion.w_radps, strict=True):
        step = exp_se3(dt_s * np.concatenate([w_radps, v_mps]))
        F = adjoint(inverse(step))
        T, cov = T @ step, F @ cov @ F.T + dt_s * np.diag(density**2)
    return T, cov


T, cov = prior.T_world_imu, prior.cov[:6, :6]
predicted = []
for packet in packets:
    T, cov = predict(T, cov, packet)
    predicted.append(T)
difference_m = largest_m(np.array(predicted), "dead-reckoning")
print(f"off the toolkit's dead-reckoning by {difference_m:.1e} m at most")
assert difference_m < 1e-9

# %% [markdown]
# ## III-B. Map the landmarks
#
# A rectified stereo pair sees a point $q = (x, y, z)$ of the left camera's frame at (eq. 3; the row is seen twice, its
# mean is kept)
#
# $$u_L = f_x \frac{x}{z} + c_x, \qquad u_R = f_x \frac{x - b}{z} + c_x, \qquad v = f_y \frac{y}{z} + c_y .$$
#
# **Exercise 3.** Write the projection, its inverse, and the derivative $\mathrm{d}(u_L, u_R, v)/\mathrm{d}q$ (eqs. 3, 4
# and 7), for N points at once.


# %%
def project(q: np.ndarray) -> np.ndarray:
    """Return (uL, uR, v) (N, 3) px of points (N, 3) in the left camera."""
    x, y, z = q.T
    left, right, row = rig.fx_px * x / z, rig.fx_px * (x - rig.baseline_m) / z, rig.fy_px * y / z
    return np.stack([left + rig.cx_px, right + rig.cx_px, row + rig.cy_px], axis=1)


def triangulate(uvs: np.ndarray) -> np.ndarray:
    """Return the points (N, 3) in the left camera that are seen at (uL, uR, v) (N, 3) px."""
    z = rig.fx_px * rig.baseline_m / (uvs[:, 0] - uvs[:, 1])
    return np.stack([(uvs[:, 0] - rig.cx_px) * z / rig.fx_px, (uvs[:, 2] - rig.cy_px) * z / rig.fy_px, z], axis=1)


def d_project(q: np.ndarray) -> np.ndarray:
    """Return d(uL, uR, v)/dq (N, 3, 3)."""
    x, y, z = q.T
    slope = np.zeros((len(q), 3, 3))
    slope[:, 0, 0] = slope[:, 1, 0] = rig.fx_px / z
    slope[:, 0, 2], slope[:, 1, 2] = -rig.fx_px * x / z**2, -rig.fx_px * (x - rig.baseline_m) / z**2
    slope[:, 2, 1], slope[:, 2, 2] = rig.fy_px / z, -rig.fy_px * y / z**2
    return slope


# %% [markdown]
# The check of a derivative is the difference of the function itself. Always make it: a wrong sign in a Jacobian looks
# like a badly tuned filter.

# %%
points = np.column_stack([rng.uniform(-5, 5, 20), rng.uniform(-2, 2, 20), rng.uniform(4, 30, 20)])
assert np.allclose(triangulate(project(points)), points)
step = 1e-6
by_difference = [(project(points + step * axis) - project(points - step * axis)) / (2 * step) for axis in np.eye(3)]
assert np.allclose(d_project(points), np.stack(by_difference, axis=2), atol=1e-5)
assert np.allclose(project(points), stereo.project(points, rig))
print("the camera and its derivative are right")

# %% [markdown]
# **Exercise 4.** One small filter a landmark (eqs. 6 to 10). With $R_{oi}$ the rotation of the IMU in the camera and
# $R$ that of the IMU in the world, $\mathrm{d}q/\mathrm{d}m = R_{oi} R^\top$; then
#
# $$K = P H^\top (H P H^\top + V)^{-1}, \qquad m \leftarrow m + K (z - \tilde z), \qquad P \leftarrow (I - K H) P .$$
#
# A landmark begins where stereo first sees it, with the covariance of that sighting carried through the triangulation.
# Points of too little disparity wait for a better frame.


# %%
class Map:
    """Landmarks by track: a point (3,) in the world and its covariance (3, 3) each; those lost from view are left."""

    def __init__(self) -> None:
        self.points: dict[int, np.ndarray] = {}
        self.covs: dict[int, np.ndarray] = {}

    def seen_again(self, packet: Packet) -> tuple[list[int], np.ndarray]:
        """Return the landmarks that the frame shows again, and their measurements; forget those it does not show."""
        frame = packet.frame
        rows = [row for row, track in enumerate(frame.track_ids.tolist()) if track in self.points]
        known = frame.track_ids[rows].tolist()
        self.points = {track: self.points[track] for track in known}
        self.covs = {track: self.covs[track] for track in known}
        return known, frame.uvs_px[rows]

    def correct(self, known: list[int], uvs: np.ndarray, T: np.ndarray) -> None:
        """Correct landmarks by their measurements from a pose that is assumed to be exact."""
        T_cam_world = inverse(T @ rig.T_imu_cam)
        for track, z in zip(known, uvs, strict=True):
            q = T_cam_world[:3, :3] @ self.points[track] + T_cam_world[:3, 3]
            H = d_project(q[None])[0] @ T_cam_world[:3, :3]
            P = self.covs[track]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + rig.cov_uv_px2)
            self.points[track] = self.points[track] + K @ (z - project(q[None])[0])
            self.covs[track] = P - K @ H @ P

    def begin(self, packet: Packet, T: np.ndarray) -> None:
        """Begin the landmarks that the frame shows for the first time."""
        T_world_cam = T @ rig.T_imu_cam
        for track, z in zip(packet.frame.track_ids.tolist(), packet.frame.uvs_px, strict=True):
            if track not in self.points and z[0] - z[1] > LEAST_DISPARITY_PX:
                q = triangulate(z[None])[0]
                back = T_world_cam[:3, :3] @ np.linalg.inv(d_project(q[None])[0])
                self.points[track] = T_world_cam[:3, :3] @ q + T_world_cam[:3, 3]
                self.covs[track] = back @ rig.cov_uv_px2 @ back.T


landmarks, everything = Map(), {}
for packet, T in zip(packets, predicted, strict=True):
    known, uvs = landmarks.seen_again(packet)
    landmarks.correct(known, uvs, T)
    landmarks.begin(packet, T)
    everything |= landmarks.points

theirs = oracle.runs["mapping"].landmarks
mine = np.array([everything[track] for track in theirs.track_ids.tolist()])
print(f"{len(mine)} landmarks, off the toolkit's mapping by {np.abs(mine - theirs.points_world).max():.1e} m at most")
assert np.allclose(mine, theirs.points_world, atol=1e-6)

# %% [markdown]
# ## III-C. Correct the pose
#
# Now the same sightings correct the pose (eqs. 11 to 14). With $p$ the landmark in the IMU's frame, a small motion
# $(\phi, \rho)$ of the IMU, on the right, moves it by $\hat p \phi - \rho$:
#
# $$H = \frac{\mathrm{d}(u_L, u_R, v)}{\mathrm{d}q} R_{oi} \begin{pmatrix} \hat p & -I \end{pmatrix} .$$
#
# **Exercise 5.** Write $H$ for one landmark, and check it by differences.


# %%
def d_pose(point: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the prediction (3,) px of a landmark from a pose, and its derivative (3, 6) to the pose."""
    p = inverse(T)[:3, :3] @ (point - T[:3, 3])
    T_cam_imu = inverse(rig.T_imu_cam)
    q = T_cam_imu[:3, :3] @ p + T_cam_imu[:3, 3]
    H = d_project(q[None])[0] @ T_cam_imu[:3, :3] @ np.hstack([hat(p), -np.eye(3)])
    return project(q[None])[0], H


point = next(iter(everything.values()))
_, H = d_pose(point, predicted[0])
moved = [[d_pose(point, predicted[0] @ exp_se3(sign * step * axis))[0] for sign in (1, -1)] for axis in np.eye(6)]
assert np.allclose(H, np.array([(plus - minus) / (2 * step) for plus, minus in moved]).T, atol=1e-4)
print("the derivative to the pose is right")

# %% [markdown]
# **Exercise 6: the report's open problem.** Stacked, N landmarks give a residual of 3N numbers, and eq. 12 inverts a
# matrix of that size. The report leaves landmarks out to make it smaller. But the measurements' noise is independent
# from landmark to landmark. Show that
#
# $$\left(P^{-1} + \sum_k H_k^\top V^{-1} H_k\right)^{-1}$$
#
# is the same covariance with matrices of 6 by 6 alone, and use it.


# %%
def correct_pose(T: np.ndarray, cov: np.ndarray, points: np.ndarray, uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correct a pose and its covariance by N landmarks that are assumed to be exact."""
    information, vector, weight = np.linalg.inv(cov), np.zeros(6), np.linalg.inv(rig.cov_uv_px2)
    for point, z in zip(points, uvs, strict=True):
        expected, H = d_pose(point, T)
        information = information + H.T @ weight @ H
        vector = vector + H.T @ weight @ (z - expected)
    corrected = np.linalg.inv(information)
    return T @ exp_se3(corrected @ vector), corrected


def by_stacking(T: np.ndarray, cov: np.ndarray, points: np.ndarray, uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same as the report writes it: the gain of all measurements at once."""
    seen = [d_pose(point, T) for point in points]
    H, residual = np.concatenate([H for _, H in seen]), (uvs - np.array([expected for expected, _ in seen])).ravel()
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.kron(np.eye(len(seen)), rig.cov_uv_px2))
    return T @ exp_se3(K @ residual), (np.eye(6) - K @ H) @ cov


tracks = [track for track in packets[0].frame.track_ids.tolist() if track in everything]
rows = np.isin(packets[0].frame.track_ids, tracks)
given = prior.T_world_imu, prior.cov[:6, :6], np.array([everything[t] for t in tracks]), packets[0].frame.uvs_px[rows]
(T_small, cov_small), (T_large, cov_large) = correct_pose(*given), by_stacking(*given)
print(f"{len(tracks)} landmarks: a matrix of 6 x 6 instead of {3 * len(tracks)} x {3 * len(tracks)}")
assert np.allclose(T_small, T_large, atol=1e-9)
assert np.allclose(cov_small, cov_large, rtol=1e-6, atol=1e-12)

# %% [markdown]
# **Exercise 7: the filter.** In the report's order: predict, correct the map from the predicted pose, then correct the
# pose by that map. Compare with `seed-ekf`, which is the report to the letter.

# %%
T, cov = prior.T_world_imu, prior.cov[:6, :6]
landmarks, mine = Map(), []
for packet in packets:
    T, cov = predict(T, cov, packet)
    known, uvs = landmarks.seen_again(packet)
    if known:
        landmarks.correct(known, uvs, T)
        T, cov = correct_pose(T, cov, np.array([landmarks.points[track] for track in known]), uvs)
    landmarks.begin(packet, T)
    mine.append(T)
difference_m = largest_m(np.array(mine), "seed-ekf")
print(f"off the toolkit's seed-ekf by {1e3 * difference_m:.3f} mm at most")
assert difference_m < 1e-3

# %% [markdown]
# A fraction of a millimetre remains: the toolkit's $W$ goes beyond the first order.
#
# ## Is it any good?

# %%
oracle.table("ATE SE(3)", "reproj held-out", "NEES pose")

# %% [markdown]
# The start is drawn with an error of its own, which all of them share: a heading wrong by a tenth of a degree is
# 10 cm after 60 m. So the figure, like **ATE SE(3)** in the table, lays each trajectory over the truth first.


# %%
def errors_m(poses: np.ndarray) -> np.ndarray:
    """Return the distances (K,) of positions from the true ones, after the rigid motion that fits them best."""
    mine, true = poses[:, :3, 3], sequence.truth.T_world_imu[:FRAMES, :3, 3]
    centred, true = mine - mine.mean(axis=0), true - true.mean(axis=0)
    left, _, right = np.linalg.svd(true.T @ centred)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return np.linalg.norm(centred @ turn.T - true, axis=1)


ekf, batch = (oracle.runs[name].final.T_world_imu for name in ("ekf", "batch"))
trajectories = {"your prediction": np.array(predicted), "your filter": np.array(mine), "ekf": ekf, "batch": batch}
_, axes = plt.subplots(figsize=(10, 3.6))
for name, poses in trajectories.items():
    axes.plot(errors_m(poses), label=name)
axes.set(xlabel="frame", ylabel="position error [m]", xlim=(0, FRAMES - 1), ylim=(0, None))
axes.legend(ncols=4)
plt.show()

# %%
sigma_m = np.sqrt(np.trace(cov[3:, 3:]))
off_m = np.linalg.norm(mine[-1][:3, 3] - sequence.truth.T_world_imu[FRAMES - 1, :3, 3])
print(f"at the end your filter states {1e3 * sigma_m:.1f} mm and is off by {1e3 * off_m:.0f} mm")

# %% [markdown]
# Before you use the trajectory, look at **NEES pose**: the squared error over the covariance that is stated, 1 for a
# consistent filter. This one uses every measurement twice, for the map and then, as if the map were exact, for the
# pose. Its covariance collapses, and from then on measurements hardly correct it.
#
# **What to do about it**, one step at a time, is the ladder of [notebook 3](03_why_the_smoother_wins.ipynb): let the
# landmark's uncertainty into the innovation and put up a gate (`ekf`), keep pose and landmarks in one state
# (`ekf-slam`), and in the end look at all of it again (`batch`).
#
# The same filters on the course's own recording, and what its data hide, are the subject of
# [notebook 2](02_the_seed_report.ipynb). Next: [your own estimator](04_your_own_estimator.ipynb), from these pieces.
