"""Does the working tree answer as a named revision did? Run before and after every refactoring; not part of the tests.

Every estimator runs on nine sequences in both trees, the revision's in a temporary directory that stands first on the
path of its processes: with gaps between frames (0027, under VISLAM_DATA), sightings in the left image alone, tracks
that return and outliers among them. Noise is measured anew, not read from the cache. Poses, covariances, landmarks,
velocities, biases, status and every metric that is no cost are compared; one line a sequence and estimator names the
largest difference of each kind. A difference is measured over max(1, |value|), that of a covariance over the two
standard deviations it belongs to. The exit status is 1 where one exceeds the tolerance or an estimator failed, 2 where
a tree could not be run.

    python tests/benchmarks/same_answers.py REVISION                  both trees, about two runs' time
    python tests/benchmarks/same_answers.py REVISION --save FILE.npz  run the revision only and keep its answers
    python tests/benchmarks/same_answers.py --against-saved FILE.npz  run the working tree only, against those
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.errors import VislamError
from toolkit.gate.interleaved import unpacked

PROJECT = Path(__file__).resolve().parents[2]
CHILD = Path(__file__).with_name("same_answers_child.py")
SEQUENCES = (
    "kitti00", "0027", "drive", "drive-imu", "drive-realistic", "flight",
    "flight-left-only", "drive-returning", "drive-outliers",
)  # fmt: skip
ESTIMATORS = (
    "dead-reckoning", "mapping", "seed-ekf", "ekf", "iekf", "riekf", "ekf-slam",
    "msckf", "msckf-fej", "msckf-slam", "smart", "sliding-window", "fixed-lag", "isam2", "batch",
)  # fmt: skip
INPUT = "(input)"
Answers = dict[str, Any]


@dataclass(frozen=True)
class Difference:
    """The largest difference of one kind: absolute, and relative to the value's scale."""

    absolute: float
    relative: float

    def or_larger(self, other: "Difference") -> "Difference":
        """Return the larger of both in each respect."""
        return Difference(max(self.absolute, other.absolute), max(self.relative, other.relative))


NONE, INCOMPARABLE = Difference(0.0, 0.0), Difference(np.inf, np.inf)


def difference(kind: str, old: Any, new: Any) -> Difference:
    """Return how far two arrays of one kind are apart; infinitely, where their shapes, ids or gaps are not the same."""
    if old.shape != new.shape:
        return INCOMPARABLE
    if old.dtype.kind not in "fc":
        return NONE if np.array_equal(old, new) else INCOMPARABLE
    gaps = np.isnan(old)
    if not np.array_equal(gaps, np.isnan(new)):
        return INCOMPARABLE
    if gaps.all():
        return NONE
    apart = np.where(old == new, 0.0, np.abs(old - new))  # infinities of one sign are the same
    if kind.endswith("covariances"):
        sigmas = np.sqrt(np.abs(np.einsum("...ii->...i", old)))
        scale = np.maximum(sigmas[..., :, None] * sigmas[..., None, :], np.finfo(float).tiny)
    else:
        scale = np.maximum(1.0, np.abs(old))
    return Difference(float(np.nanmax(apart, initial=0.0)), float(np.nanmax(apart / scale, initial=0.0)))


def compared(old: Answers, new: Answers) -> Iterator[tuple[str, Difference]]:
    """Yield the difference of each kind of one estimator's answers; both outputs of a kind count as one.

    What the new tree answers in addition (a new metric, say) is not compared; what it lacks is a difference.
    """
    by_kind: dict[str, Difference] = {}
    for key, value in old.items():
        kind = "metrics" if "/metrics/" in key else key.removeprefix("causal/").removeprefix("final/")
        found = difference(kind, value, new[key]) if key in new else INCOMPARABLE
        by_kind[kind] = by_kind.get(kind, NONE).or_larger(found)
    yield from by_kind.items()


def answers_of(answers: Answers, sequence: str, estimator: str) -> Answers:
    """Return one estimator's answers by kind."""
    prefix = f"{sequence}/{estimator}/"
    return {key.removeprefix(prefix): value for key, value in answers.items() if key.startswith(prefix)}


def run_tree(tree: Path, sequence: str, wanted: argparse.Namespace) -> Answers:
    """Return what the estimators of a tree answer on a sequence, from a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "answers.npz")
        frames = 0 if wanted.all_frames else wanted.kitti_frames
        command = [sys.executable, str(CHILD), sequence, str(frames), str(out), *wanted.estimators]
        environment = {**os.environ, "PYTHONPATH": str(tree), "VISLAM_CACHE": folder}
        done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise VislamError(f"{sequence} in {tree}:\n{done.stderr}")
        return read(out)


def read(path: Path) -> Answers:
    """Read the answers of a file."""
    with np.load(path, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


def run_trees(trees: Mapping[str, Path], wanted: argparse.Namespace) -> dict[str, Answers]:
    """Run every sequence in every tree, as many processes at a time as are wanted."""
    with ThreadPoolExecutor(wanted.processes) as pool:
        pairs = [(side, sequence) for sequence in wanted.sequences for side in trees]
        jobs = [pool.submit(run_tree, trees[side], sequence, wanted) for side, sequence in pairs]
        found: dict[str, Answers] = {side: {} for side in trees}
        for (side, _), job in zip(pairs, jobs, strict=True):
            found[side] |= job.result()
        return found


def print_comparison(old: Answers, new: Answers, wanted: argparse.Namespace) -> bool:
    """Print one line a sequence and estimator; say whether all differences stay within the tolerance."""
    agree = True
    for sequence in wanted.sequences:
        for estimator in (INPUT, *wanted.estimators):
            before = answers_of(old, sequence, estimator)
            if not before:
                raise VislamError(f"{sequence} {estimator}: the saved answers have none of it")
            kinds = dict(compared(before, answers_of(new, sequence, estimator)))
            beyond = [kind for kind, found in kinds.items() if not found.relative <= wanted.tolerance]
            failed = str(before.get("status")) == "failed"  # then there is nothing to compare
            agree = agree and not beyond and not failed
            reported = [f"{kind} {d.absolute:.1e} ({d.relative:.1e})" for kind, d in kinds.items() if d.absolute > 0.0]
            verdict = "FAILED " if failed else "DIFFERS" if beyond else "agrees " if reported else "same   "
            print(f"{verdict} {sequence:<16} {estimator:<15} {', '.join(reported)}", flush=True)
            for key in [k for k in before if "/metrics/" in k] if "metrics" in beyond else []:
                now = answers_of(new, sequence, estimator).get(key, "absent")
                if now == "absent" or difference("metrics", before[key], now).relative > wanted.tolerance:
                    print(f"            {key}: {before[key]} -> {now}")
    return agree


def parsed(words: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", nargs="?", help="git revision to compare with")
    parser.add_argument("--tolerance", type=float, default=1e-9, help="largest relative difference (%(default)g)")
    parser.add_argument("--estimators", nargs="+", default=list(ESTIMATORS), metavar="NAME")
    parser.add_argument("--sequences", nargs="+", default=list(SEQUENCES), metavar="NAME", choices=SEQUENCES)
    parser.add_argument("--kitti-frames", type=int, default=25, help="first frames of kitti00 (default %(default)s)")
    parser.add_argument("--all-frames", action="store_true", help="all 140 frames of kitti00: some run for minutes")
    parser.add_argument("--processes", type=int, default=2, help="runs side by side (default %(default)s)")
    saved = parser.add_mutually_exclusive_group()
    saved.add_argument("--save", type=Path, metavar="FILE", help="run the revision only and keep its answers")
    saved.add_argument("--against-saved", type=Path, metavar="FILE", help="compare with these answers")
    wanted = parser.parse_args(words)
    if (wanted.revision is None) == (wanted.against_saved is None):
        parser.error("name either a revision or a file of saved answers")
    return wanted


def main(words: list[str]) -> int:
    """Run what is asked for; return the exit status."""
    wanted = parsed(words)
    try:
        with ExitStack() as stack:
            trees = {} if wanted.save else {"new": PROJECT}
            if wanted.revision is not None:
                (trees["old"],) = stack.enter_context(unpacked(wanted.revision))
            found = run_trees(trees, wanted)
        if wanted.save:
            np.savez_compressed(wanted.save, **found["old"])
            return 0
        old = read(wanted.against_saved) if wanted.against_saved else found["old"]
        return 0 if print_comparison(old, found["new"], wanted) else 1
    except VislamError as reason:
        print(reason, file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
