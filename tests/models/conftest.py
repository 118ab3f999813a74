"""The one check of every Jacobian."""

from collections.abc import Callable

import numpy as np

from toolkit.geometry import Array

# Five-point central differences err by h^4 / 30 of the fifth derivative and by the last digits of the values over h;
# for functions that vary on the scale of 1, as ours do in radians and metres, both are below 1e-11 of the values here.
_STEP = 1e-3


def numerical_jacobian(function: Callable[[Array], Array], size: int) -> Array:
    """Return d f / d x (..., n) at x = 0 of a function of x (n,), by five-point central differences."""
    columns = []
    for unit in _STEP * np.eye(size):
        near, far = function(unit) - function(-unit), function(2.0 * unit) - function(-2.0 * unit)
        columns.append((8.0 * near - far) / (12.0 * _STEP))
    return np.stack(columns, axis=-1)
