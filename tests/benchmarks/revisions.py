"""How much of a causal held-out error is no error of motion but a revision, as by estimators that learn a gyro bias.

    python tests/benchmarks/revisions.py [--estimators ekf,ekf-slam,msckf-slam,fixed-lag]

Five parts of 20 s of drive 0027 (folder ``ucsd`` of the data), whose twists are noisy and whose tracks all end in one
interval of twelve. A bias that is learned turns what lies behind such an interval against what lies before it, and with
it the poses said from then on against those said earlier. The table has, for each part and estimator, the held-out
error (px) and the ATE SE(3) (m) of the causal output, with the bias as it is estimated and with one that is given: the
one ``batch`` ends with.
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from toolkit.experiment.recording import Part, Prepared, Recording, prepare
from toolkit.measurements import TwistNoise
from toolkit.metrics import score_run
from toolkit.registry import find
from toolkit.runner import run

PARTS = [Part(begin_s, begin_s + 20.0) for begin_s in (0.0, 20.0, 40.0, 60.0, 80.0)]
GYRO_BIAS = slice(12, 15)
# As good as known; a covariance must be positive definite.
KNOWN_RADPS = 1e-6


def prepared(part: Part) -> Prepared:
    """Return a part of the drive."""
    folder = Path(os.environ.get("VISLAM_DATA", "../shared/data")) / "ucsd"
    return prepare(Recording(str(folder / "0027.npz"), truth=folder / "gt/0027.tum", part=part))


def with_known_bias(ready: Prepared) -> Prepared:
    """Return the same with the gyro bias that ``batch`` finds as a constant that is known."""
    smoothed = run("batch", find("batch").load(), ready.sequence, ready.prior).final
    assert smoothed is not None and smoothed.bias is not None and isinstance(ready.sequence.noise, TwistNoise)
    cov = ready.prior.cov.copy()
    cov[GYRO_BIAS], cov[:, GYRO_BIAS] = 0.0, 0.0
    cov[GYRO_BIAS, GYRO_BIAS] = KNOWN_RADPS**2 * np.eye(3)
    noise = replace(ready.sequence.noise, gyro_random_walk=np.full(3, 1e-9))
    return replace(
        ready,
        sequence=replace(ready.sequence, noise=noise),
        prior=replace(ready.prior, bias=smoothed.bias[0], cov=cov),
    )


def figures(name: str, ready: Prepared) -> str:
    """Return held-out error and ATE of an estimator's causal output."""
    values = score_run(run(name, find(name).load(), ready.sequence, ready.prior), "causal", ready.sequence).values
    return f"{values['heldout_reproj_median_px']:6.2f} px {values['ate_se3_m']:6.2f} m"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--estimators", default="ekf,ekf-slam,msckf-slam,fixed-lag")
    names = parser.parse_args().estimators.split(",")
    print(f"{'part':>12}  {'estimator':<12} {'bias estimated':>18} {'bias given':>20}", flush=True)
    for part in PARTS:
        ready = prepared(part)
        known = with_known_bias(ready)
        for name in names:
            both = "  ".join(figures(name, it) for it in (ready, known))
            print(f"{part.from_s:5g}-{part.to_s:g} s  {name:<12} {both}", flush=True)


if __name__ == "__main__":
    main()
