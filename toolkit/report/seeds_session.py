"""From a simulated source to a run directory over many seeds; what ``vislam compare --seeds`` does."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from toolkit.estimator import EstimatorEntry, find_all
from toolkit.experiment.monte_carlo import OverSeeds, in_order
from toolkit.experiment.trial import Trial, sequence_of
from toolkit.experiment.workers import outcomes_of
from toolkit.files import check_parent
from toolkit.report.run_directory import check_run_directory, write_over_seeds
from toolkit.report.session import STARTS, ProgressFor, Request, changes_of, unique_names
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence


@dataclass(frozen=True)
class OverSeedsRequest:
    """A request, repeated over ``count`` seeds from its own on by ``workers`` processes at a time."""

    request: Request
    count: int
    workers: int

    @property
    def seeds(self) -> tuple[int, ...]:
        """Return the seeds."""
        return tuple(range(self.request.seed, self.request.seed + self.count))


def compare_over_seeds(asked: OverSeedsRequest, progress_for: ProgressFor) -> Iterator[tuple[OverSeeds, Path]]:
    """Compare the estimators on every source over all seeds; yield each once its run directory is in place.

    As :func:`toolkit.report.session.compare_all` checks first and raises. Sources must be drawn from the seed.
    """
    request = asked.request
    entries = find_all(request.estimators)
    for entry in entries.values():
        entry.load()  # one that cannot be used is told before hours of others have run
    names = unique_names(request.sources)
    directories = [request.out] if len(names) == 1 else [request.out / name for name in names]
    if len(names) > 1:
        check_parent(request.out)
    for directory in directories:
        check_run_directory(directory)
    for source, directory in zip(request.sources, directories, strict=True):
        over, first = run_over_seeds(source, asked, entries, progress_for)
        with progress_for(f"{over.name}: figures and report"):
            write_over_seeds(over, first, directory, command=request.command)
        yield over, directory


def run_over_seeds(
    source: str, asked: OverSeedsRequest, entries: dict[str, EstimatorEntry], progress_for: ProgressFor
) -> tuple[OverSeeds, Sequence]:
    """Run everything on one source; return what came of it and the recording of the first seed."""
    request, estimators = asked.request, tuple(entries)
    start = STARTS[request.start]
    trials = [Trial(source, seed, estimators, start, request.max_frames, request.keep) for seed in asked.seeds]
    with progress_for(f"{source}: loading and checking"):
        first = sequence_of(trials[0])
    outcomes, total = [], len(trials) * len(estimators)
    with (
        progress_for(f"{first.name}: {total} runs over {asked.count} seeds") as progress,
        closing(outcomes_of(trials, asked.workers)) as coming,
    ):
        progress.advance(0, total)
        for outcome in coming:
            outcomes.append(outcome)
            if len(outcomes) < total:
                progress.advance(len(outcomes), total)
    over = OverSeeds(
        name=first.name,
        source=source,
        motion=first.motion_kind,
        seeds=asked.seeds,
        start=start(first).source,
        frames_s=(first.frames_t_ns - first.frames_t_ns[0]) / NS_PER_S,
        estimators=estimators,
        outcomes=in_order(outcomes, estimators, asked.seeds),
        workers=asked.workers,
        changes=changes_of(request, entries),
    )
    return over, first
