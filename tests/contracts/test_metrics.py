"""The contract of every metric file, and the keys that metrics.json promises."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit import metrics
from toolkit.answers import Run, Timings
from toolkit.estimate import Landmarks, Trajectory
from toolkit.geometry import se3
from toolkit.sequence import Truth
from toolkit.simulation import DRIVE, simulate

# What later versions added, each behind a key of the contract in the order of tables.
_BLOCKS = ("variance", "pose", "vel", "bias")
ADDED = {
    "end_drift_percent": ["clock_offset_ms", "clock_offset_error_ms"],
    "heldout_reproj_rmse_px": ["heldout_over_motion", "heldout_over_motion_error"],
    "nees_pose_in_band_percent": ["nees_vel_mean", "nees_gyro_bias_mean", "nees_accel_bias_mean"]
    + [f"inside_{percent}_{block}_percent" for block in ("pose", "ori", "pos") for percent in (50, 90, 95)]
    + ["log_score_pose", "log_score_ori", "log_score_pos", "energy_ori_deg", "energy_pos_m"],
    "nis_mean": ["gate_accepted_percent", "correction_trend", "correction_trend_limit"],
    "pairs": ["efficiency_percent", "bound_position_m", "bound_rotation_deg", "error_over_bound"]
    + [f"{kind}_{block}" for kind in ("excess", "claimed") for block in _BLOCKS],
    "peak_rss_mb": ["frame_cpu_ms_mean"],
}
KEYS = [key for known in metrics.CONTRACT_KEYS for key in (known, *ADDED.get(known, ()))]


BARE = simulate(replace(DRIVE, duration_s=0.2), 0)
BARE = replace(BARE, observations=BARE.observations.select(BARE.observations.frame < 0), prior=None)
TRUTHS = {
    "none": None,
    "empty": Truth(np.empty(0), np.empty((0, 4, 4))),
    "three": Truth(BARE.frames_t_ns, se3(np.eye(3), np.outer(np.arange(3.0), [1.0, 0.0, 0.0]))),
}


def test_the_keys_are_those_of_metrics_json_in_its_order_each_described_in_a_line_and_on_the_page(request):
    described = metrics.describe()
    assert list(described) == KEYS
    assert [key for key in KEYS if not described[key] or "\n" in described[key]] == []
    page = (request.config.rootpath / "docs" / "metrics.md").read_text(encoding="utf-8")
    assert [key for key in KEYS if f"`{key}`" not in page] == []
    names = [name for metric in metrics.known_metrics() for name in {metric.key, metric.name}]
    assert len(set(names)) == len(names), "two columns have the same name"


@pytest.mark.parametrize("output", ["causal", "final"])
@pytest.mark.parametrize("truth", TRUTHS)
@pytest.mark.parametrize(
    "poses",
    [
        np.empty((0, 4, 4)),
        np.full((3, 4, 4), np.nan),
        np.zeros((3, 4, 4)),
        np.full((3, 4, 4), 1e300),
        se3(np.eye(3), np.zeros((3, 3))),
        se3(np.eye(3), np.zeros((1, 3))),
    ],
    ids=["empty", "nan", "zero", "huge", "still", "one"],
)
def test_every_key_has_a_finite_value_or_a_reason(output, truth, poses):
    trajectory = Trajectory(BARE.frames_t_ns[: len(poses)], poses)
    run = Run("bare", "failed", trajectory, trajectory, Landmarks.none(), Timings(np.empty(0), 0.0, 0.0, 0.0, None))
    scores = metrics.score_run(run, output, replace(BARE, truth=TRUTHS[truth]))
    assert list(scores.values) == KEYS
    for key, value in scores.values.items():
        assert np.isfinite(value) if value is not None else scores.notes[key]
