"""How long a window should be: what windowed filters and smoothers lose against the bound; not part of the tests.

The excess variance needs few seeds, for the draw of noise that all share is taken off. The default of window.lag_s was
chosen from this, on seeds from 700 on.

    python tests/benchmarks/window_lengths.py      flight, drive and drive-imu, fifteen minutes on one core
"""

import argparse

import numpy as np

import toolkit

ESTIMATORS = ("msckf-fej", "msckf-slam", "fixed-lag")


def print_lengths(source: str, wanted: argparse.Namespace) -> None:
    """Print a line a length: the mean excess variance of each estimator with its standard error, and its time."""
    print(f"\n{source}, {wanted.frames} frames, {wanted.seeds} seeds: excess variance, CPU ms a frame")
    for lag_s in wanted.lengths:
        settings = {"window": {"lag_s": lag_s}, "metrics": {"bound": True}}
        result = toolkit.compare(
            source, ESTIMATORS, max_frames=wanted.frames, seed=wanted.first, seeds=wanted.seeds, settings=settings
        )
        cells = []
        for name in ESTIMATORS:
            values = {key: [] for key in ("excess_variance", "frame_cpu_ms_mean")}
            for record in result.records():
                if record.estimator == name and record.output == "causal" and record.metric in values:
                    values[record.metric].append(record.value)
            excess = np.array(values["excess_variance"], dtype=float)
            error = excess.std(ddof=1) / np.sqrt(excess.size)
            cells.append(f"{name} {excess.mean():.3f} +- {error:.3f}, {np.mean(values['frame_cpu_ms_mean']):.1f} ms")
        print(f"{lag_s:4g} s   " + "   ".join(cells), flush=True)


def main() -> None:
    """Print a table a recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", default=["flight", "drive", "drive-imu"])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=700, help="the first seed (default %(default)s)")
    parser.add_argument("--lengths", type=float, nargs="+", default=[0.6, 0.8, 1.0, 1.2, 1.4])
    wanted = parser.parse_args()
    for source in wanted.sources:
        print_lengths(source, wanted)


if __name__ == "__main__":
    main()
