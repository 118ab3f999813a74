"""A long finish reports its progress, iteration by iteration."""

from dataclasses import replace

import pytest

from toolkit import runner
from toolkit.registry import find
from toolkit.simulation import DRIVE, simulate


class Recorded:
    """Keeps every report."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int, str]] = []

    def advance(self, done: int, total: int, stage: str = "") -> None:
        self.calls.append((done, total, stage))


@pytest.mark.parametrize(("name", "stages"), [("batch", 3), ("isam2", 1)])
def test_every_iteration_of_the_last_solves_is_reported(name, stages):
    sequence, progress = simulate(replace(DRIVE, duration_s=2.0), 0), Recorded()
    runner.run(name, find(name).load(), sequence, sequence.prior, progress)
    solving = [call for call in progress.calls if call[2]]
    assert len({stage for _, _, stage in solving}) == stages
    for stage in {stage for _, _, stage in solving}:
        done = [k for k, _, of in solving if of == stage]
        assert done == list(range(len(done)))
        assert all(k < total for k, total, of in solving if of == stage)
