"""Is what a format's ``load`` returned a sequence, part by part? Formats of other packages may return anything."""

from numbers import Real

from toolkit.errors import DataError
from toolkit.sequence import Observations, Provenance, Sequence, StereoRig, why_not_sightings


def check_types(sequence: Sequence) -> None:
    """Raise DataError where a part is of another type, or a table of another length, than whoever loads one returns."""
    whose = sequence.name if isinstance(sequence.name, str) else "a recording"
    parts = {"name": str, "rig": StereoRig, "observations": Observations, "provenance": Provenance}
    found = {part: (getattr(sequence, part), kind) for part, kind in parts.items()}
    if isinstance(sequence.rig, StereoRig):
        of_rig = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")
        found |= {f"rig.{part}": (getattr(sequence.rig, part), Real) for part in of_rig}
    for part, (value, kind) in found.items():
        if not isinstance(value, kind):
            raise DataError(f"{whose}: its {part} is of type {type(value).__name__}, expected {kind.__name__}")
    for vector in getattr(sequence.motion, "VECTORS", ()):
        if len(getattr(sequence.motion, vector)) != sequence.motion.t_ns.size:
            rows, stamps = len(getattr(sequence.motion, vector)), sequence.motion.t_ns.size
            raise DataError(f"{whose}: motion.{vector} has {rows} rows, and there are {stamps} stamps")
    if why := why_not_sightings(sequence):
        raise DataError(f"{whose}: {why}")
