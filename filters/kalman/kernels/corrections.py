"""Parts of corrections compiled: motions and images.

The NumPy definitions are ``toolkit.geometry.se3_exp`` and ``multiview.NUMPY``.
"""

import numpy as np

from filters.kalman.kernels.algebra import inverses
from filters.kalman.kernels.compiling import kept, what_was_compiled
from filters.kalman.kernels.rigid_motions import exponential
from filters.kalman.kernels.sightings import linearise
from filters.kalman.kernels.signatures import CAMERA, MATRIX, STACK, Arrays
from toolkit.geometry import Array

# Points (F, 3), poses (W, 4, 4), camera.
IMAGES = (MATRIX, STACK, CAMERA)


@kept((MATRIX,))
def exponentials(twists: Array) -> Array:
    """Return the motions (N, 4, 4) of twists (N, 6), [rotation, translation], by the exponential map."""
    motions = np.empty((twists.shape[0], 4, 4))
    for k in range(twists.shape[0]):
        exponential(twists[k], motions[k : k + 1])
    return motions


@kept(IMAGES)
def predict_images(points: Array, poses: Array, camera: Arrays) -> Arrays:
    """Return the images of F points in W poses, (uL, uR, v) (F, W, 3) px, Jacobians and depths; see :data:`IMAGES`.

    The Jacobians to the pose (F, W, 18) and to the point (F, W, 9) are flattened row by row; depths (F, W) m.
    """
    count, window = points.shape[0], poses.shape[0]
    latest, eye = inverses(poses), (camera[0], inverses(camera[1]), np.zeros((3, 3)))
    uvs_px, depths, where = np.zeros((count, window, 3)), np.empty((count, window)), np.zeros(1, dtype=np.int64)
    d_pose, d_point = np.empty((count, window, 18)), np.empty((count, window, 9))
    H_pose, H_point = np.empty((3, 6)), np.empty((3, 4))
    for i in range(3):
        eye[2][i, i] = 1.0
    for f in range(count):
        for j in range(window):
            where[0] = j
            depths[f, j] = linearise(points, f, uvs_px, where, (latest, poses, latest), eye, (H_pose, H_point))
            for i in range(3):
                uvs_px[f, j, i] = -H_point[i, 3]
                for c in range(6):
                    d_pose[f, j, 6 * i + c] = H_pose[i, c]
                for c in range(3):
                    d_point[f, j, 3 * i + c] = H_point[i, c]
    return uvs_px, d_pose, d_point, depths


COMPILED = what_was_compiled(predict_images, "the parts of a correction were")
