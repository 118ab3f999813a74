"""How close estimators come to the Cramér-Rao bound where the errors of tracks are correlated and this is stated.

    python tests/benchmarks/bound_of_tracks.py run results.jsonl [--seeds 20] [--slips none]
    python tests/benchmarks/bound_of_tracks.py table results.jsonl

``drive-realistic`` of 10 s and ``flight-realistic`` of 3 s. The noise of tracks is that of the scenario by channel
(``stated``) or fitted to the recording (``fitted``); tracks slip as the scenario has it (``some``) or do not
(``none``). Each run is one line of the results, and one that is there is not made again. The table has the mean over
seeds of the variance beyond the bound, and the stated variance over the true one, with standard errors.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from toolkit.estimator import find
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_cov
from toolkit.metrics import score_run
from toolkit.runner import run
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, simulate
from toolkit.track_errors import fit_track_noise

DURATION_S = {"drive-realistic": 10.0, "flight-realistic": 3.0}
OUTPUTS = {
    "msckf-fej": ("causal",),
    "msckf-slam": ("causal",),
    "fixed-lag": ("causal",),
    "isam2": ("causal", "final"),
    "batch": ("final",),
}


class Case(NamedTuple):
    """One recording: a scenario, its seed, where the noise of tracks comes from, and whether tracks slip."""

    scenario: str
    seed: int
    tracks: str
    slips: str


@lru_cache(maxsize=1)  # one bound for all estimators
def recording(case: Case) -> Sequence:
    """Return the recording with its noise of tracks stated."""
    scenario = replace(SCENARIOS[case.scenario], duration_s=DURATION_S[case.scenario])
    sequence = simulate(scenario if case.slips == "some" else replace(scenario, slip_share=0.0), case.seed)
    noise = scenario.track_noise if case.tracks == "stated" else fit_track_noise(sequence).noise
    return replace(sequence, rig=replace(sequence.rig, track_noise=noise))


def scored(case: Case, estimator: str) -> Iterator[dict[str, Any]]:
    """Yield what the bound says of each output of a run."""
    sequence = recording(case)
    assert sequence.prior is not None
    made = run(estimator, find(estimator).load(), sequence, sequence.prior)
    for output in OUTPUTS[estimator]:
        found = score_run(made, output, sequence, ("bound",), only=["bound"])
        yield {
            **case._asdict(),
            "estimator": estimator,
            "output": output,
            "status": made.status,
            "values": dict(found.values),
            "why": found.notes.get("excess_variance"),
        }


def table(lines: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table."""
    groups = defaultdict[tuple[str, ...], list[dict[str, Any]]](list)
    for line in lines:
        groups[tuple(line[key] for key in ("scenario", "tracks", "slips", "estimator", "output"))].append(line)
    for key, runs in sorted(groups.items()):
        values = [one["values"] for one in runs if one["values"]["excess_variance"] is not None]
        if len(values) < 2:
            yield f"| {' | '.join(key)} | {len(values)} of {len(runs)} with a bound, {runs[0]['why'] or 'too few'} |"
            continue
        excess, pose, stated = (
            np.array([one[name] for one in values]) for name in ("excess_variance", "excess_pose", "claimed_variance")
        )
        ratio = _stated_of_true(stated, excess)[0]
        error_of_ratio = np.sqrt(jackknife_cov(_stated_of_true, stated, excess, stretches=len(values))[0, 0])
        errors = (np.std(part, ddof=1) / np.sqrt(len(values)) for part in (excess, pose))
        shown = [f"{part.mean():.3f} ± {error:.3f}" for part, error in zip((excess, pose), errors, strict=True)]
        shown.append(f"{ratio:.2f} ± {error_of_ratio:.2f}")
        yield f"| {' | '.join((*key, f'{len(values)} of {len(runs)}', *shown))} |"


def _stated_of_true(stated: Array, excess: Array) -> Array:
    """Return the stated variance over the true one (1,) from both over the bound (N,), the second without it."""
    return np.array([stated.mean() / (1.0 + excess.mean())])


def main() -> None:
    """Make the runs that are requested, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("results", type=Path)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--scenarios", default=",".join(DURATION_S))
    parser.add_argument("--tracks", default="stated,fitted")
    parser.add_argument("--slips", default="none,some")
    parser.add_argument("--estimators", default=",".join(OUTPUTS))
    options = parser.parse_args()
    known = [json.loads(line) for line in options.results.read_text().splitlines()] if options.results.exists() else []
    if options.what == "table":
        print("\n".join(table(known)))
        return
    done = {(*(one[key] for key in Case._fields), one["estimator"]) for one in known}
    scenarios, tracks = options.scenarios.split(","), options.tracks.split(",")
    each = [(t, p) for t in tracks for p in options.slips.split(",")]
    cases = [Case(s, seed, t, p) for t, p in each for seed in range(options.seeds) for s in scenarios]
    for case in cases:
        for estimator in options.estimators.split(","):
            if (*case, estimator) not in done:
                with options.results.open("a") as results:
                    results.writelines(json.dumps(line) + "\n" for line in scored(case, estimator))


if __name__ == "__main__":
    main()
