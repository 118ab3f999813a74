"""What a fixed-lag smoother's marginals are linearised at: NEES of the heading and error, over seeds of simulations.

The table that GTSAM's issue 2456 asks for. Every variant sees the same draws without outliers, gates or losses; of the
causal answers it prints mean and standard error of the heading's NEES (the error about the vertical, squared, over its
variance) and of the position's RMSE, this as a ratio to that of `invariant` marginals on the same draw. Runs that did
not end well are counted; means are over the draws on which all did.

    python tests/benchmarks/marginals_table.py flight 10 --seeds 30 [--first-seed 700] [--states 50]
"""

import argparse
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from toolkit import runner
from toolkit.answers import Run
from toolkit.geometry import se3_inverse, se3_log
from toolkit.registry import find
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, Settings, Window
from toolkit.simulation import SCENARIOS, simulate

REFERENCE = "invariant"
# What leaves GTSAM's own window stays linearised at first estimates.
MARGINALS = {"first": "fixed-lag", "latest": "sliding-window", REFERENCE: "sliding-window"}


def run(sequence: Sequence, states: int, marginals: str) -> Run:
    """Run the window whose marginals are linearised so over a sequence."""
    name = MARGINALS[marginals]
    options = {} if name == "fixed-lag" else {name: {"marginals": marginals}}
    settings = Settings(outliers=POLICIES["none"], window=Window(most_states=states), estimators=options)
    assert sequence.prior is not None
    return runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)


def scored(done: Run, sequence: Sequence) -> tuple[float, float]:
    """Return the mean NEES of the heading and the RMSE of the position in m, of causal answers; NaN if it failed."""
    if done.status != "ok":
        return np.nan, np.nan
    answered, truth = done.causal, sequence.truth
    assert answered is not None and answered.cov is not None and truth is not None
    R_world_imu, true_poses = answered.T_world_imu[:, :3, :3], truth.T_world_imu[: len(answered.t_ns)]
    rotation = se3_log(se3_inverse(answered.T_world_imu) @ true_poses)[:, :3]
    up = R_world_imu[:, 2]  # the vertical in the body's axes
    variance = np.einsum("ni,nij,nj->n", up, answered.cov[:, :3, :3], up)
    nees = np.square(np.einsum("ni,ni->n", up, rotation)) / variance
    off_m = answered.T_world_imu[:, :3, 3] - true_poses[:, :3, 3]
    return float(nees[1:].mean()), float(np.sqrt(np.square(off_m).sum(axis=1).mean()))


def with_error(values: Iterable[float]) -> str:
    """Return mean and standard error of values."""
    each = np.array(list(values))
    return f"{each.mean():.3f} ± {each.std(ddof=1) / np.sqrt(each.size):.3f}"


def main() -> None:
    """Run every variant over every seed and print a row for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenario", choices=sorted(SCENARIOS))
    parser.add_argument("seconds", type=float)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=700)
    parser.add_argument("--states", default="50", help="values of window.most_states (default %(default)s)")
    given = parser.parse_args()
    variants = [(int(states), marginals) for states in given.states.split(",") for marginals in MARGINALS]
    scores: list[list[tuple[float, float]]] = []
    for seed in range(given.first_seed, given.first_seed + given.seeds):
        sequence = simulate(replace(SCENARIOS[given.scenario], duration_s=given.seconds), seed)
        scores.append([scored(run(sequence, *variant), sequence) for variant in variants])
        print(seed, np.round(scores[-1], 4).tolist(), flush=True)
    nees, rmse_m = np.moveaxis(np.array(scores), 2, 0)
    failed = np.isnan(rmse_m)
    sound = ~failed.any(axis=1)
    print(f"\n{given.scenario}, {given.seconds:g} s, {sound.sum()} of {given.seeds} draws")
    print("\n| states | marginals | failed | NEES heading | RMSE, m | RMSE / that of invariant |")
    print("|---|---|---|---|---|---|")
    for place, (states, kind) in enumerate(variants):
        of_reference = rmse_m[:, variants.index((states, REFERENCE))]
        figures = (nees[:, place], rmse_m[:, place], rmse_m[:, place] / of_reference)
        row = [str(states), kind, str(failed[:, place].sum()), *(with_error(one[sound]) for one in figures)]
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
