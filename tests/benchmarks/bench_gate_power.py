"""How often the accuracy gate raises a false alarm, and how often it sees a regression of 2, 5 and 10 percent.

Not part of the test run. The model of a neutral change and of a planted regression is in gate_pool.py. A pool of
neutral pairs is measured once (long: every estimator runs twice under every seed); a check is then drawn from it as
the gate would meet it: as many seeds as the gate uses, drawn independently from the pool, each with either side as
the baseline, a regression planted in one estimator on all its sequences, and the verdicts by the gate's own code.
The shipped baseline may have more tests than the pool: they are filled up with such as never fail, for they cost power
(Holm). A regression is *seen* where the check fails for an ATE of that estimator: the NEES would help.

Intervals are the central 95 % of the rates of pools drawn from the pool (bootstrap over seeds), each with its own
checks; they hold the chance of the pool as well as of the checks.

    python tests/benchmarks/bench_gate_power.py fill POOL [SEEDS [PROCESSES [ESTIMATOR ...]]]
    python tests/benchmarks/bench_gate_power.py rates POOL [TESTS [SEEDS_OF_A_CHECK ...]]
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import gate_pool

from toolkit.gate.baseline import DEFAULT_BOUNDS, FALSE_ALARM_RATE
from toolkit.gate.paired import Pairs, Where, rejected, worse_p

CASES = {"flight": 2.5, "drive": 25.0}
ESTIMATORS = ("dead-reckoning", "ekf", "msckf-fej", "batch")
POOLS, CHECKS = 60, 100
ATE = ("ate_se3_m", "ate_yaw_m")
Table = np.ndarray[Any, np.dtype[np.float64]]
Rows = np.ndarray[Any, np.dtype[np.int64]]
Fails = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Size:
    """Seeds and tests of a check, and by what its margins are multiplied."""

    seeds: int
    tests: int
    margins: float = 1.0


@dataclass(frozen=True, eq=False)
class Column:
    """One metric of one estimator in the pool: values (seeds, sides) by level of the plant."""

    where: Where
    values: dict[str, Table]

    def pairs(self, drawn: Rows, flipped: Rows, level: str, margins: float) -> Pairs:
        """Return what checks over the seeds drawn (..., n) would compare; the plant is on the side that is new."""
        neutral, planted = self.values["0"], self.values.get(level, self.values["0"])
        criterion = DEFAULT_BOUNDS.simulated[self.where.metric]
        criterion = replace(criterion, percent=margins * criterion.percent)
        return Pairs(self.where, criterion, neutral[drawn, flipped], planted[drawn, 1 - flipped])

    @property
    def spread_percent(self) -> float:
        """Root mean square of the log ratio of a neutral pair, in percent."""
        sides = np.log(self.values["0"])
        return 100.0 * float(np.sqrt(np.mean((sides[:, 1] - sides[:, 0]) ** 2)))


def columns(pool: list[dict[str, Any]]) -> Iterator[Column]:
    """Yield every metric that the gate would test, over the seeds both of whose sides ended well."""
    for source in CASES:
        lines = [line for line in pool if line["source"] == source]
        names = sorted({key.split("/")[0] for line in lines for key in line if "/" in key})
        for name in names:
            sides = [[line[f"{name}/{side}"] for side in gate_pool.SIDES] for line in lines]
            good = [pair for pair in sides if all(side["status"] == "ok" for side in pair)]
            for output in good[0][0]["levels"]["0"]:
                for metric in DEFAULT_BOUNDS.simulated:
                    values = {
                        level: np.array([[side["levels"][level][output].get(metric) for side in pair] for pair in good])
                        for level in good[0][0]["levels"]
                    }
                    kept = {level: v.astype(float) for level, v in values.items() if not (v == None).any()}  # noqa: E711
                    if kept:
                        yield Column(Where(source, name, output, metric), kept)


def drawn_checks(every: list[Column], size: Size, planted: tuple[str, str]) -> Fails:
    """Return what fails (pools, checks, columns) of checks over pools that are drawn from the pool."""
    rng = np.random.default_rng(0)
    # A pool drawn from the pool has as many seeds, drawn with replacement; of those a check draws its own.
    pools = {source: rng.integers(0, 1 << 30, (POOLS, 1 << 10)) for source in CASES}
    draws = {source: rng.integers(0, 1 << 10, (POOLS, CHECKS, size.seeds)) for source in CASES}
    flips = {source: rng.integers(0, 2, (POOLS, CHECKS, size.seeds)) for source in CASES}
    p_values = np.ones((POOLS, CHECKS, size.tests))
    for i, column in enumerate(every):
        count, source = column.values["0"].shape[0], column.where.sequence
        seeds = np.take_along_axis(pools[source][:, None], draws[source] % count, axis=-1) % count
        level = planted[1] if column.where.estimator == planted[0] else "0"
        p_values[..., i] = worse_p(column.pairs(seeds, flips[source], level, size.margins))
    return rejected(p_values, FALSE_ALARM_RATE)[..., : len(every)]


def told(rates: Table) -> str:
    """Return a rate with its interval, in percent."""
    low, high = np.percentile(rates, [2.5, 97.5])
    return f"{100.0 * np.mean(rates):5.1f} [{100.0 * low:3.0f}, {100.0 * high:3.0f}]"


def print_rates(pool: list[dict[str, Any]], tests: int, seeds: int) -> None:
    """Print the false-alarm rate and, by estimator and level, how often an ATE regression is seen."""
    every = list(columns(pool))
    size = Size(seeds, max(tests, len(every)))
    print(f"\n{seeds} seeds, {size.tests} tests ({len(every)} of the pool), {POOLS} pools of {CHECKS} checks each")
    for what, one in (("", size), (", were there no margin", Size(seeds, len(every), 0.0))):
        alarms = drawn_checks(every, one, ("", "0")).any(axis=-1).mean(axis=-1)
        print(f"false alarms in a check without a regression{what}: {told(alarms)} %")
    names = sorted({column.where.estimator for column in every})
    levels = [f"{level:g}" for level in gate_pool.LEVELS_PERCENT if level]
    alone = [f"5 % on {source} only" for source in CASES]
    heads = [*(f"{level} % planted" for level in levels), *alone]
    print(f"{'seen, percent':<18}" + "".join(f"{head:>22}" for head in heads))
    for name in names:
        fails = {level: drawn_checks(every, size, (name, level)) for level in levels}
        cells = [told(_seen(every, fails[level], name, tuple(CASES))) for level in levels]
        cells += [told(_seen(every, fails["5"], name, (source,))) for source in CASES]
        print(f"{name:<18}" + "".join(f"{cell:>22}" for cell in cells), flush=True)


def _seen(every: list[Column], fails: Fails, name: str, sources: tuple[str, ...]) -> Table:
    """Return the share (pools,) of the checks that fail for an ATE of an estimator on any of the sequences."""
    wheres = [column.where for column in every]
    of_it = [w.estimator == name and w.metric in ATE and w.sequence in sources for w in wheres]
    return np.asarray(fails[..., of_it].any(axis=-1).mean(axis=-1))


def print_spreads(pool: list[dict[str, Any]]) -> None:
    """Print how much a neutral pair differs, by metric, and how the time of a block of seeds scatters."""
    metrics = list(DEFAULT_BOUNDS.simulated)
    print(f"{'spread, %':<34}{'seeds':>6}" + "".join(f"{metric:>26}" for metric in metrics))
    rows: dict[tuple[str, ...], dict[str, Column]] = {}
    for column in columns(pool):
        w = column.where
        rows.setdefault((w.sequence, w.estimator, w.output), {})[w.metric] = column
    for where, by_metric in rows.items():
        cells = "".join(f"{by_metric[m].spread_percent:26.2f}" if m in by_metric else f"{'-':>26}" for m in metrics)
        print(f"{' '.join(where):<34}{next(iter(by_metric.values())).values['0'].shape[0]:>6}{cells}")


def print_speeds(pool: list[dict[str, Any]], runs: int) -> None:
    """Print the largest ratio between the median times of two blocks of runs, measured at different times."""
    print(f"\nlargest ratio of median time over the reference's, between any two blocks of {runs} runs in a row:")
    for source in CASES:
        lines = [line for line in pool if line["source"] == source]
        for name in sorted({key.split("/")[0] for line in lines for key in line if "/" in key}):
            speeds = np.array([line[f"{name}/{side}"]["speed"] for line in lines for side in gate_pool.SIDES])
            blocks = speeds[: speeds.size // runs * runs].reshape(-1, runs)
            if len(blocks) > 1:
                medians, single = np.median(blocks, axis=1), 100.0 * float(np.std(np.log(speeds)))
                ratio = medians.max() / medians.min()
                print(f"{source + ' ' + name:<26}{ratio:6.2f}   of {len(blocks)} blocks; one run {single:.0f} %")


def main(words: list[str]) -> None:
    """Fill a pool, or print what it says."""
    if len(words) < 2 or words[0] not in ("fill", "rates"):
        sys.exit(__doc__)
    path = Path(words[1])
    if words[0] == "fill":
        count, processes = (int(word) for word in (*words[2:4], *("60", "2")[len(words[2:4]) :]))
        gate_pool.fill(path, CASES, range(count), tuple(words[4:]) or ESTIMATORS, processes)
        return
    pool = list(gate_pool.read(path))
    print_spreads(pool)
    tests = int(words[2]) if len(words) > 2 else 0
    sizes = [int(word) for word in words[3:]] or [24]
    for seeds in sizes:
        print_rates(pool, tests, seeds)
    print_speeds(pool, sizes[0])


if __name__ == "__main__":
    main(sys.argv[1:])
