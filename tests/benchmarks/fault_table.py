"""What faults of a recording cost each estimator, and whether the run says what is wrong; not part of the tests.

Each fault of toolkit.simulation.faults is planted in each recording, which is then audited and run as a user would. A
cell is the position error (ATE after a yaw alignment) over that of the sound recording; in brackets where the run says
that something is wrong: by its status, by its mark (overconfident, timid) or by a warning or a blocking finding of the
audit that the sound recording has not; what was repaired is no excuse for an error. What must not be is a cell above
the limit without brackets.

    python tests/benchmarks/fault_table.py                    drive and flight, about ten minutes on one core
    python tests/benchmarks/fault_table.py 0027.npz --truth 0027.tum --estimators ekf,batch
"""

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import toolkit
from toolkit.audit import Finding
from toolkit.datasets import load_sequence
from toolkit.datasets.io.truth import load_truth, with_truth
from toolkit.errors import VislamError
from toolkit.sequence import Sequence
from toolkit.simulation import faults

ESTIMATORS = ("ekf", "ekf-slam", "msckf-fej", "msckf-slam", "fixed-lag", "isam2", "smart", "batch")
FAULTS: dict[str, Callable[[Sequence], Sequence]] = {
    "10 % of the sightings lost": faults.dropped_sightings,
    "1 s without sight": faults.blackout,
    "0.5 s without motion": faults.motion_gap,
    "30 % outlier tracks": faults.outlier_tracks,
    "camera 20 ms late": faults.camera_clock,
    "3 tracks a frame": faults.few_tracks,
    "10 s of standstill": faults.standstill,
    "0.25 s not a number": faults.nan_span,
    "clock jumps back 0.5 s": faults.clock_jump,
    "camera 0.25 s late": partial(faults.camera_clock, dose=0.25),
    "twice the noise stated": faults.wrong_noise,
    "sight to one side": faults.one_sided_view,
}


@dataclass(frozen=True)
class Ended:
    """How one run ended: its error (m) or None, and whether it says that something is wrong."""

    ate_m: float | None
    reported: bool


def ended(sequence: Sequence, estimators: tuple[str, ...], usual: frozenset[str]) -> dict[str, Ended]:
    """Run the estimators over a recording; ``usual`` names what the audit finds in the sound one."""
    try:
        comparison = toolkit.compare(sequence, estimators).comparison
    except VislamError:  # refused, in words
        return dict.fromkeys(estimators, Ended(None, reported=True))
    found = _telling(comparison.findings) - usual
    rows = {row.estimator: row for row in comparison.rows}  # the final one stays
    return {
        name: Ended(row.value("ate_yaw_m"), bool(found) or row.status != "ok" or bool(row.mark))
        for name, row in rows.items()
    }


def _telling(findings: Iterable[Finding]) -> frozenset[str]:
    """Return the faults that a reader is told to read results with in mind, or that block."""
    return frozenset(finding.fault for finding in findings if finding.warning or finding.blocking)


def cell(now: Ended, clean: Ended) -> str:
    """Return the ratio of the errors, in brackets where the run says that something is wrong."""
    ratio = "-" if now.ate_m is None or not clean.ate_m else f"{now.ate_m / clean.ate_m:.1f}"
    return f"[{ratio}]" if now.reported else ratio


def is_silent(now: Ended, clean: Ended, limit: float) -> bool:
    """Say whether a run is worse than the limit allows, or without a result, and says nothing."""
    return not now.reported and (now.ate_m is None or (clean.ate_m is not None and now.ate_m > limit * clean.ate_m))


def print_table(sequence: Sequence, wanted: argparse.Namespace) -> tuple[int, int]:
    """Print a recording's table; return how many cells are silent, and of how many."""
    usual = _telling(toolkit.compare(sequence, "dead-reckoning").comparison.findings)
    clean = ended(sequence, wanted.estimators, usual)
    print(f"\n{sequence.name}, {sequence.duration_s:.0f} s\n{'':<28}" + "".join(f"{n:>12}" for n in wanted.estimators))
    print(f"{'sound: ATE yaw, mm':<28}" + "".join(f"{1e3 * (clean[n].ate_m or 0):>12.1f}" for n in wanted.estimators))
    silent = cells = 0
    for name, plant in FAULTS.items():
        try:
            faulty = plant(sequence)
        except VislamError as reason:
            print(f"{name:<28}  not planted: {reason}")
            continue
        now = ended(faulty, wanted.estimators, usual)
        print(f"{name:<28}" + "".join(f"{cell(now[n], clean[n]):>12}" for n in wanted.estimators), flush=True)
        silent += sum(is_silent(now[n], clean[n], wanted.limit) for n in wanted.estimators)
        cells += len(wanted.estimators)
    return silent, cells


def main(words: list[str]) -> int:
    """Print the tables; exit 1 where a cell is silent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", default=["drive", "flight"], help="paths or built-in names")
    parser.add_argument("--truth", type=Path, help="of the one recording given")
    parser.add_argument("--estimators", type=lambda text: tuple(text.split(",")), default=ESTIMATORS)
    parser.add_argument("--frames", type=int, default=120, help="first frames of each recording (default %(default)s)")
    parser.add_argument("--limit", type=float, default=3.0, help="most a fault may cost in silence (%(default)s)")
    wanted = parser.parse_args(words)
    counts = []
    for recording in wanted.recordings:
        sequence = load_sequence(recording)
        if wanted.truth is not None:
            sequence = with_truth(sequence, *load_truth(wanted.truth))
        counts.append(print_table(sequence.truncated(wanted.frames), wanted))
    silent, cells = map(sum, zip(*counts, strict=True))
    print(f"\n{silent} of {cells} cells are above {wanted.limit:g} and say nothing")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
