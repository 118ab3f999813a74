"""Tests whether the code became slower: old and new code run in turns on the same recording and processor.

Other load of the machine slows both sides of a pair alike. The number of pairs is decided by the scatter of the first
ones, not by their mean (Stein, Annals of Mathematical Statistics 16, 1945); the test is Wilcoxon's signed-rank test,
which is robust to single runs that were delayed. The other version, a git revision or a wheel, is unpacked beside the
installed one while it is timed.
"""

import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from toolkit.errors import printable
from toolkit.experiment.statistics import holm
from toolkit.gate import timing_child
from toolkit.gate.baseline import SPEED, Baseline, BaselineError, Case
from toolkit.gate.measuring import recordings_of
from toolkit.gate.significance import POWER
from toolkit.gate.verdict import Finding, Verdict, Where, verdict_on
from toolkit.geometry import Array
from toolkit.progress import ProgressFor
from toolkit.settings import changes_of
from toolkit.threads import THREAD_VARIABLES

# A slowdown by 5 % is accepted; one by 15 % must be found.
MARGIN, TO_SEE = 0.05, 0.15
FEWEST_PAIRS, MOST_PAIRS = 16, 60
# Enough to be timed; a batch smoother's whole drive takes seconds.
LONGEST_S = 5.0
_TAILS_PERCENT, _TAILS_OF_NORMAL = (10.0, 90.0), 1.2816


@dataclass(frozen=True, eq=False)
class TimedPairs:
    """One estimator on one case: seconds of processor time of the old and the new code, pair by pair (n, 2)."""

    case: str
    estimator: str
    cpu_s: Array

    @property
    def differences(self) -> Array:
        """Logarithms (n,) of the new code's time over the old one's."""
        logs: Array = np.log(self.cpu_s)
        return logs[:, 1] - logs[:, 0]


def compare_speed(
    baseline: Baseline, version: str, rate: float, progress_for: ProgressFor
) -> tuple[list[Verdict], list[str]]:
    """Judge the time of a baseline's estimators, the installed code's against another version's; also return notes.

    Raises BaselineError where the version cannot be found or cannot be timed.
    """
    timed, verdicts, notes = timed_in_turn(baseline, version, progress_for)
    return [*verdicts, *check_speeds(timed, version, rate)], notes


def timed_in_turn(
    baseline: Baseline, version: str, progress_for: ProgressFor
) -> tuple[list[TimedPairs], list[Verdict], list[str]]:
    """Time the estimators of a baseline in both versions; what only the other could be timed on is missing."""
    cases = [case for case, _ in baseline.cases if case.simulated] or [case for case, _ in baseline.cases]
    names = sorted({name for case in cases for name in case.estimators})
    timed, verdicts, notes = list[TimedPairs](), list[Verdict](), list[str]()
    with unpacked(version) as path, timers(path, (Path(timing_child.__file__).parents[2],)) as sides:
        known_to = [side.request("where", estimators=names) for side in sides]
        if known_to[0] == known_to[1]:
            here_too = known_to[0]["toolkit"]
            raise BaselineError(f"{version} does not contain the code that runs here ({here_too}); name another")
        there, here = ({name for name in names if side["files"][name] is not None} for side in known_to)
        if new := [name for name in names if name not in there]:
            notes.append(f"{', '.join(new)}: not in {version}, and not timed")
        for case in cases:
            known = [name for name in case.estimators if name in there]
            verdicts += [_not_timed(case.source, name, "is not there any more") for name in known if name not in here]
            both = [name for name in known if name in here]
            with progress_for(f"{case.source}: speed against {version}") as progress:
                _prepare(sides, case, baseline)
                for done, name in enumerate(both):
                    progress.advance(done, len(both))
                    there_ends, here_ends = (
                        side.request("run", estimator=name)["status"] for side in sides
                    )  # warms up
                    if there_ends == here_ends == "ok":
                        timed.append(_times(sides, case.source, name))
                    elif there_ends == "ok":
                        verdicts.append(_not_timed(case.source, name, f"ends {here_ends} here and ended well there"))
                    else:
                        ends = f"ends {there_ends} there and {here_ends} here"
                        notes.append(f"{case.source}: {name} {ends}, and is not timed")
    return timed, verdicts, notes


def _not_timed(case: str, estimator: str, why: str) -> Verdict:
    return verdict_on(Where(case, estimator, "", SPEED), "missing", why)


def check_speeds(found: Sequence[TimedPairs], version: str, rate: float) -> Iterator[Verdict]:
    """Yield the verdict on each estimator; the chance of any false alarm among them is at most ``rate``."""
    slower, faster = (
        holm(np.array([_beyond_p(sign * timed.differences) for timed in found], dtype=float)).tolist()
        for sign in (1.0, -1.0)
    )
    for timed, p, p_faster in zip(found, slower, faster, strict=True):
        finding: Finding = "regressed" if p <= rate else "better" if p_faster <= rate else "same"
        ratio, (was, is_) = float(np.exp(np.median(timed.differences))), np.median(timed.cpu_s, axis=0).tolist()
        message = f"{ratio:.2f} times the processor time of {version}, in {len(timed.cpu_s)} runs in turn"
        seen = 100.0 * float(np.expm1(_detectable(timed.differences, rate / len(found))))
        where, change = Where(timed.case, timed.estimator, "", SPEED), 100.0 * (ratio - 1.0)
        yield verdict_on(
            where, finding, "" if finding == "same" else message, was, is_, change, 100.0 * MARGIN,
            p=p_faster if finding == "better" else p, seen_percent=seen,
        )  # fmt: skip


def _beyond_p(differences: Array) -> float:
    """Return the p-value that the median of differences (n,) exceeds the margin."""
    from scipy.stats import wilcoxon  # its import takes as long as all others together, and most checks do not need it

    excess = differences - np.log1p(MARGIN)
    return float(wilcoxon(excess, alternative="greater").pvalue) if np.any(excess) else 1.0


def _scale(differences: Array) -> float:
    return float(np.ptp(np.percentile(differences, _TAILS_PERCENT))) / (2.0 * _TAILS_OF_NORMAL)


def _detectable(differences: Array, rate: float) -> float:
    """Return the change that one test at ``rate`` finds with 95 % power; its efficiency is 3/pi of the t-test's."""
    error = _scale(differences) * np.sqrt(np.pi / 3.0 / differences.size)
    return float(np.log1p(MARGIN) + (ndtri(POWER) - ndtri(rate)) * error)


def pairs_needed(differences: Array) -> int:
    """Return how many pairs are needed to find TO_SEE, by the scatter of the first ones (n,)."""
    excess = np.log1p(TO_SEE) - np.log1p(MARGIN)
    # Five standard errors: 3.2 for the test at 0.05 over some 60 of them, 1.6 for the power, and some in hand.
    needed = np.ceil(np.pi / 3.0 * (5.0 * _scale(differences) / excess) ** 2)
    return int(np.clip(needed, FEWEST_PAIRS, MOST_PAIRS))


class Process:
    """A version of the code in a process of its own, which answers requests in JSON."""

    def __init__(self, process: "subprocess.Popen[str]", what: str) -> None:
        self._process, self._what = process, what

    def request(self, do: str, **requested: object) -> dict[str, Any]:
        """Return the answer; raises BaselineError where there is none."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps({"do": do, **requested}) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        answer: dict[str, Any] = json.loads(line) if line else {"error": "its process ended"}
        if "error" in answer:
            raise BaselineError(f"{self._what} cannot be timed: {answer['error']}; name a later one")
        return answer


@contextmanager
def timers(*paths: Sequence[Path]) -> Iterator[tuple[Process, ...]]:
    """Start a process for each version, whose path stands first in it; none is left when the context ends."""
    with ExitStack() as stack:
        started = []
        single = dict.fromkeys(THREAD_VARIABLES, "1")
        before = [value] if (value := os.environ.get("PYTHONPATH")) else []
        for what, path in zip(("the other version", "this version"), paths, strict=True):
            process = subprocess.Popen(
                [sys.executable, "-P", timing_child.__file__],
                env={**os.environ, **single, "PYTHONPATH": os.pathsep.join([*map(str, path), *before])},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            stack.callback(_end, process)
            started.append(Process(process, what))
        yield tuple(started)


def _end(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def _prepare(sides: Sequence[Process], case: Case, baseline: Baseline) -> None:
    recording = recordings_of(case, baseline.settings)[0]
    for side in sides:
        side.request(
            "prepare",
            source=recording.source,
            seed=recording.seed,
            truth=None if recording.truth is None else str(recording.truth),
            duration_s=min(LONGEST_S, case.duration_s or LONGEST_S),
            settings=changes_of(baseline.settings),
        )


def _times(sides: Sequence[Process], source: str, estimator: str) -> TimedPairs:
    """Time both sides in turn, as often as the scatter of the first pairs requires."""
    pairs = np.array([_pair(sides, estimator, k) for k in range(FEWEST_PAIRS)])
    more = pairs_needed(TimedPairs(source, estimator, pairs).differences)
    further = [_pair(sides, estimator, k) for k in range(FEWEST_PAIRS, more)]
    return TimedPairs(source, estimator, np.array([*pairs.tolist(), *further]))


def _pair(sides: Sequence[Process], estimator: str, k: int) -> tuple[float, float]:
    """Return the seconds of the old and the new code; every second time the new code goes first."""
    times = {side: float(sides[side].request("run", estimator=estimator)["cpu_s"]) for side in ((0, 1), (1, 0))[k % 2]}
    return times[0], times[1]


@contextmanager
def unpacked(version: str) -> Iterator[tuple[Path, ...]]:
    """Unpack a wheel, or a git revision of the checkout one stands in, for a while; yield what to put on the path.

    Raises BaselineError where it is neither.
    """
    with tempfile.TemporaryDirectory(prefix="vislam-") as folder:
        tree = Path(folder).resolve()
        if Path(version).suffix == ".whl":
            _unpack_wheel(Path(version), tree)
        else:
            _unpack_revision(version, tree)
        yield tuple(path for path in (tree / "src", tree) if path.is_dir())


def _unpack_wheel(wheel: Path, folder: Path) -> None:
    try:
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
    except (OSError, zipfile.BadZipFile) as error:
        why = getattr(error, "strerror", None) or error
        raise BaselineError(f"{wheel}: it is no wheel that can be read ({why}); build one with pip wheel") from error


def _unpack_revision(revision: str, folder: Path) -> None:
    top = _git(
        "rev-parse",
        "--show-toplevel",
        otherwise=f"{revision}: the current directory is not in a checkout; change to one, or name a wheel",
    )
    shallow = _git("rev-parse", "--is-shallow-repository", otherwise=revision).strip() == b"true"
    deepen = (
        "fetch it, because this clone is shallow (git fetch --unshallow)" if shallow else "name one that git log shows"
    )
    unknown = f"{revision!r} is no revision of this checkout; {deepen}, or name a wheel"
    commit = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}", otherwise=unknown)
    archive = _git("archive", commit.decode().strip(), otherwise=unknown, folder=top.decode().removesuffix("\n"))
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        packed.extractall(folder, filter="data")


def _git(*arguments: str, otherwise: str, folder: str = ".") -> bytes:
    """Return what git prints; raises BaselineError with its complaint and what stands ``otherwise`` where it fails."""
    try:
        done = subprocess.run(["git", "-C", folder, *arguments], capture_output=True, check=False)
    except OSError as error:
        raise BaselineError(f"--speed-against: git cannot be run ({error.strerror}); name a wheel") from error
    if done.returncode:
        complaint = printable(done.stderr.decode(errors="replace").strip())
        raise BaselineError(f"--speed-against {otherwise}{complaint and f' ({complaint})'}")
    return done.stdout
