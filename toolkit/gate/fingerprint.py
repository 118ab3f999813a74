"""Are two sequences the same measurements, up to what another processor rounds differently?

The same simulation differs in its last bits from one processor to the next, since numeric libraries choose other
instructions there; its content hash then differs in everything. The fingerprint is a hash of the same content rounded
to six digits of each array's largest value: the chance that a last bit crosses a rounding step is below 1e-4 a
sequence, and any other change of a measurement by more than one part in a million shows.
"""

from toolkit.sequence import Sequence

_DIGITS = 6
_LENGTH = 16


def fingerprint(sequence: Sequence) -> str:
    """Return the rounded hash of what an estimator can see and of the truth, in 16 hexadecimal digits."""
    return sequence.content_hash(_DIGITS)[:_LENGTH]
