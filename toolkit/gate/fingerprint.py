"""Are two sequences the same measurements, up to what another processor rounds differently?

The same simulation differs in its last bits from one processor to the next, since numeric libraries choose other
instructions there; its content hash then differs in everything. The fingerprint is a hash of the same content rounded
to six digits of each array's largest value: the chance that a last bit crosses a rounding step is below 1e-4 a
sequence, and any other change of a measurement by more than one part in a million shows.
"""

import hashlib
from dataclasses import fields, is_dataclass

import numpy as np

from toolkit.geometry import Array
from toolkit.sequence import Sequence

_DIGITS = 6
_LENGTH = 16


def fingerprint(sequence: Sequence) -> str:
    """Return the rounded hash of what an estimator can see and of the truth, in 16 hexadecimal digits."""
    digest = hashlib.sha256()
    s = sequence
    parts = (s.frames_t_ns, s.gravity_world, s.rig, s.noise, s.observations, s.motion, s.truth, s.prior)
    for part in parts:
        _feed(digest, part)
    return digest.hexdigest()[:_LENGTH]


def _feed(digest: "hashlib._Hash", value: object) -> None:
    if isinstance(value, np.ndarray):
        rounded = _rounded(value) if value.dtype.kind == "f" else value
        digest.update(str(value.shape).encode())
        digest.update(np.ascontiguousarray(rounded).data)
    elif is_dataclass(value):
        for field in fields(value):
            _feed(digest, getattr(value, field.name))
    else:
        digest.update((f"{value:.{_DIGITS}g}" if isinstance(value, float) else repr(value)).encode())


def _rounded(array: Array) -> Array:
    finite = np.abs(array[np.isfinite(array)])
    largest = float(finite.max()) if finite.size else 0.0
    if largest == 0.0:
        return array + 0.0
    decimals = _DIGITS - 1 - int(np.floor(np.log10(largest)))
    return np.round(array, decimals) + 0.0  # not -0.0, whose bits differ
