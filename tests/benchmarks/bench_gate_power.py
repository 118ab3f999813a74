"""How often the accuracy gate raises a false alarm, and how often it sees a planted change.

Not part of the test run. The model of a neutral change and of the planted ones is in gate_pool.py. A pool is measured
once (long: every estimator runs twice under every seed, and once for each plant); a check is then drawn from it as
the gate would meet it: as many seeds as the gate uses, drawn independently from the pool, and the verdicts by the
gate's own code. Of a neutral change and of an error that grows by some percent, either side is the baseline at random
and every estimator's answers scatter; an everyday mistake is compared with the same code without it, under the same
seeds, while the other estimators answer as they did. The shipped baseline may have more tests than the pool: they are
filled up with such as never fail, for they cost power (Holm).

Intervals are the central 95 % of the rates of pools drawn from the pool (bootstrap over seeds), each with its own
checks; they hold the chance of the pool as well as of the checks.

    python tests/benchmarks/bench_gate_power.py fill POOL [SEEDS [PROCESSES [ESTIMATOR ...]]]
    python tests/benchmarks/bench_gate_power.py rates POOL [TESTS [SEEDS_OF_A_CHECK ...]]
    python tests/benchmarks/bench_gate_power.py turns TIMES REVISION     pairs of times of old and new code in turn
    python tests/benchmarks/bench_gate_power.py speeds TIMES             what --speed-against sees in them
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import gate_pool

from toolkit.experiment.statistics import holm
from toolkit.gate import interleaved
from toolkit.gate.baseline import DEFAULT_BOUNDS, FALSE_ALARM_RATE, Baseline, Case, Measured
from toolkit.gate.checking import changed_metrics
from toolkit.gate.significance import Pairs
from toolkit.gate.verdict import Where
from toolkit.progress import silent

CASES = {"flight": 2.5, "drive": 25.0}
ESTIMATORS = ("dead-reckoning", "ekf", "msckf-fej", "batch")
POOLS, CHECKS = 60, 100
MOST_TIMED = 40
Table = np.ndarray[Any, np.dtype[np.float64]]
Rows = np.ndarray[Any, np.dtype[np.int64]]
Fails = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Size:
    """Seeds and tests of a check."""

    seeds: int
    tests: int


@dataclass(frozen=True, eq=False)
class Column:
    """One metric of one estimator in the pool: values (seeds, sides) by level, and (seeds,) by everyday mistake."""

    where: Where
    values: dict[str, Table]
    plants: dict[str, Table]

    def pairs(self, drawn: Rows, flipped: Rows, plant: str) -> Pairs:
        """Return what checks over the seeds drawn (..., n) would compare; the plant is on the side that is new."""
        neutral, criterion = self.values["0"], DEFAULT_BOUNDS.simulated[self.where.metric]
        if plant in self.plants:
            return Pairs(self.where, criterion, neutral[drawn, 0], self.plants[plant][drawn])
        planted = self.values.get(plant, neutral)
        return Pairs(self.where, criterion, neutral[drawn, flipped], planted[drawn, 1 - flipped])

    @property
    def spread_percent(self) -> float:
        """Root mean square of the log ratio of a neutral pair, in percent."""
        sides = np.log(self.values["0"])
        return 100.0 * float(np.sqrt(np.mean((sides[:, 1] - sides[:, 0]) ** 2)))


def columns(pool: list[dict[str, Any]]) -> Iterator[Column]:
    """Yield every metric that the gate would test, over the seeds under which all runs ended well."""
    for source in CASES:
        lines = [line for line in pool if line["source"] == source]
        names = sorted({key.split("/")[0] for line in lines for key in line if "/" in key})
        for name in names:
            sides = [[line[f"{name}/{side}"] for side in gate_pool.SIDES] for line in lines]
            good = [pair for pair in sides if _is_good(pair)]
            for output in good[0][0]["levels"]["0"]:
                for metric in DEFAULT_BOUNDS.simulated:
                    levels = {
                        level: [[side["levels"][level][output].get(metric) for side in pair] for pair in good]
                        for level in good[0][0]["levels"]
                    }
                    plants = {
                        plant: [pair[0]["plants"][plant]["scores"][output].get(metric) for pair in good]
                        for plant in good[0][0]["plants"]
                    }
                    if levels["0"][0][0] is not None:
                        where = Where(source, name, output, metric)
                        yield Column(where, _tables(levels), _tables(plants))


def _is_good(pair: list[dict[str, Any]]) -> bool:
    ends = [side["status"] for side in pair] + [plant["status"] for plant in pair[0]["plants"].values()]
    return all(end == "ok" for end in ends)


def _tables(values: dict[str, Any]) -> dict[str, Table]:
    tables = {key: np.array(table, dtype=float) for key, table in values.items()}
    return {key: table for key, table in tables.items() if np.isfinite(table).all()}


def drawn_checks(every: list[Column], size: Size, planted: tuple[str, str]) -> tuple[Fails, Fails]:
    """Return which columns moved and which became worse (pools, checks, columns) in checks over pools drawn anew."""
    rng = np.random.default_rng(0)
    # A pool drawn from the pool has as many seeds, drawn with replacement; of those a check draws its own.
    pools = {source: rng.integers(0, 1 << 30, (POOLS, 1 << 10)) for source in CASES}
    draws = {source: rng.integers(0, 1 << 10, (POOLS, CHECKS, size.seeds)) for source in CASES}
    flips = {source: rng.integers(0, 2, (POOLS, CHECKS, size.seeds)) for source in CASES}
    moved, worse = (np.ones((POOLS, CHECKS, size.tests)) for _ in range(2))
    name, plant = planted
    everyday = any(plant in column.plants for column in every)
    for i, column in enumerate(every):
        if everyday and column.where.estimator != name:
            continue  # the others answer as they did
        count, source = column.values["0"].shape[0], column.where.sequence
        seeds = np.take_along_axis(pools[source][:, None], draws[source] % count, axis=-1) % count
        pairs = column.pairs(seeds, flips[source], plant if column.where.estimator == name else "0")
        moved[..., i], worse[..., i] = pairs.moved_p(), pairs.worse_p()
    kept = slice(len(every))
    return (
        (holm(moved) <= FALSE_ALARM_RATE)[..., kept] | (holm(worse) <= FALSE_ALARM_RATE / 2.0)[..., kept],
        (holm(worse) <= FALSE_ALARM_RATE / 2.0)[..., kept],
    )


def reported(rates: Table) -> str:
    """Return a rate with its interval, in percent."""
    low, high = np.percentile(rates, [2.5, 97.5])
    return f"{100.0 * np.mean(rates):5.1f} [{100.0 * low:3.0f}, {100.0 * high:3.0f}]"


def print_rates(pool: list[dict[str, Any]], tests: int, seeds: int) -> None:
    """Print the false-alarm rate and, by estimator and plant, how often a check fails."""
    every = list(columns(pool))
    size = Size(seeds, max(tests, len(every)))
    print(f"\n{seeds} seeds, {size.tests} tests ({len(every)} of the pool), {POOLS} pools of {CHECKS} checks each")
    names = sorted({column.where.estimator for column in every})
    print(f"{'fail, percent':<30}" + "".join(f"{name:>22}" for name in ("as it is", "accepting better")))
    _print_row("nothing planted", every, size, ("", "0"))
    plants = [f"{level:g}" for level in gate_pool.LEVELS_PERCENT if level]
    plants += sorted({plant for column in every for plant in column.plants})
    for plant in plants:
        for name in names:
            of_it = [column for column in every if column.where.estimator == name]
            if any(_moves(column, plant) for column in of_it):
                _print_row(f"{plant}, {name}", every, size, (name, plant))
    for name in names:
        print(f"{gate_pool.MEAN_ATE}, {name}: {_changed(every, name) or 'not reported as a changed metric'}")


def _moves(column: Column, plant: str) -> bool:
    """Say whether a plant does anything to a column: dead reckoning has no pixels to be noisy."""
    if plant in column.plants:
        return not np.array_equal(column.plants[plant], column.values["0"][:, 0])
    return plant in column.values


def _print_row(what: str, every: list[Column], size: Size, planted: tuple[str, str]) -> None:
    fails = drawn_checks(every, size, planted)
    cells = [reported(np.asarray(one.any(axis=-1).mean(axis=-1))) for one in fails]
    print(f"{what:<38}" + "".join(f"{cell:>22}" for cell in cells), flush=True)


def _changed(every: list[Column], name: str) -> str:
    """Return the metrics reported as computed differently where the ATE is a mean; all of the pool's seeds count."""
    found = set[str]()
    for source in CASES:
        of_it = [column for column in every if (column.where.sequence, column.where.estimator) == (source, name)]
        for output in {column.where.output for column in of_it}:
            values = {
                column.where.metric: (column.values["0"][:, 0], column.plants[gate_pool.MEAN_ATE])
                for column in of_it
                if column.where.output == output
            }
            found |= {f"{source} {key}" for key in changed_metrics(values)}
    return ", ".join(sorted(found))


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


def measure_turns(times: Path, revision: str) -> None:
    """Write MOST_TIMED pairs of times of each estimator on each sequence, the code here against a revision."""
    cases = [Case(source, True, (0,), ESTIMATORS, seconds) for source, seconds in CASES.items()]
    baseline = Baseline({}, tuple((case, Measured((), (), {})) for case in cases))
    with patch.object(interleaved, "pairs_needed", lambda _differences: MOST_TIMED):
        found, _, _ = interleaved.timed_in_turn(baseline, revision, silent)
    lines = [json.dumps([one.case, one.estimator, one.cpu_s.tolist()]) for one in found]
    times.write_text("\n".join(lines) + "\n", encoding="utf-8")


def print_speeds_in_turn(times: Path) -> None:
    """Print how often a check fails whose new code takes so many times as long in one estimator."""
    rows = [json.loads(line) for line in times.read_text(encoding="utf-8").splitlines()]
    every = [interleaved.TimedPairs(case, name, np.array(pairs)) for case, name, pairs in rows]
    rng = np.random.default_rng(0)
    checks = 400
    print(f"{checks} checks of {len(every)} estimators on sequences, {len(every[0].cpu_s)} pairs of each in the pool")
    for slower in (1.0, 1.1, 1.15, 1.2):
        failed, counts = np.zeros(len(every)), []
        for _ in range(checks):
            k = int(rng.integers(len(every)))
            drawn = [_drawn_turns(one, slower if i == k else 1.0, rng) for i, one in enumerate(every)]
            verdicts = list(interleaved.check_speeds(drawn, "before", FALSE_ALARM_RATE))
            failed[k] += verdicts[k].finding == "regressed" if slower > 1.0 else any(v.fails for v in verdicts)
            counts += [len(one.cpu_s) for one in drawn]
        print(f"{slower:5.2f} times the time: {100.0 * failed.sum() / checks:5.1f} % fail; {np.mean(counts):.0f} pairs")


def _drawn_turns(one: interleaved.TimedPairs, ratio: float, rng: np.random.Generator) -> interleaved.TimedPairs:
    """Return pairs in a row from a random start, either side as the old code, as many as the gate would run."""
    begin, flip = int(rng.integers(len(one.cpu_s))), int(rng.integers(2))
    pairs = np.roll(one.cpu_s, -begin, axis=0)[:, :: 1 - 2 * flip] * np.array([1.0, ratio])
    rolled = interleaved.TimedPairs(one.case, one.estimator, pairs)
    count = interleaved.pairs_needed(rolled.differences[: interleaved.FEWEST_PAIRS])
    return interleaved.TimedPairs(one.case, one.estimator, pairs[:count])


def main(words: list[str]) -> None:
    """Fill a pool, or print what it says."""
    if len(words) < 2 or words[0] not in ("fill", "rates", "turns", "speeds"):
        sys.exit(__doc__)
    path = Path(words[1])
    if words[0] == "turns":
        measure_turns(path, words[2])
        return
    if words[0] == "speeds":
        print_speeds_in_turn(path)
        return
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
