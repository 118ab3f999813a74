"""What to do when GTSAM finds a system indeterminate: whom it names, and how to hold it where it is."""

import re

import gtsam
import numpy as np

# What holds a variable that nothing else determines: m of a landmark; rad, m, m/s of a state.
WEAK_SIGMA = 1.0


def variable_named(refusal: RuntimeError) -> int:
    """Return the key of the variable GTSAM says it was working near; any other refusal is raised again."""
    named = re.search(r"near variable\s+(\d+)", str(refusal))
    if named is None:
        raise refusal
    return int(named.group(1))


def weak_hold(key: int, values: gtsam.Values) -> gtsam.NonlinearFactor:
    """Return a factor that holds a variable loosely at its value."""
    at = values.extract([key])
    size = at.dim()
    noise = gtsam.noiseModel.Isotropic.Sigma(size, WEAK_SIGMA)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(key, np.eye(size), np.zeros(size), noise), at)


def without_gaps(factors: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a graph whose slots may be empty."""
    compact = gtsam.NonlinearFactorGraph()
    for slot in range(factors.size()):
        if factors.exists(slot):
            compact.add(factors.at(slot))
    return compact
