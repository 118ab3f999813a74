"""The one check of every Jacobian, and the real sightings and intervals the models are compared with GTSAM on."""

from collections.abc import Callable

import numpy as np
import pytest

from toolkit.geometry import Array

JacobianOf = Callable[[Callable[[Array], Array], int], Array]

# Five-point central differences err by h^4 / 30 of the fifth derivative and by the last digits of the values over h;
# for functions that vary on the scale of 1, as ours do in radians and metres, both are below 1e-11 of the values here.
_STEP = 1e-3


@pytest.fixture(scope="session")
def numerical_jacobian() -> JacobianOf:
    """Return d f / d x (..., n) at x = 0 of a function of x (n,), by five-point central differences."""

    def jacobian(function: Callable[[Array], Array], size: int) -> Array:
        columns = []
        for unit in _STEP * np.eye(size):
            near, far = function(unit) - function(-unit), function(2.0 * unit) - function(-2.0 * unit)
            columns.append((8.0 * near - far) / (12.0 * _STEP))
        return np.stack(columns, axis=-1)

    return jacobian
