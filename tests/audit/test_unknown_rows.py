"""Rows of left and right that a file does not have: said to be not decidable, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.datasets import own_tables
from toolkit.simulation import DRIVE, simulate


@pytest.mark.parametrize("rows", [("v",), ("vL", "vR")])
def test_rows_that_may_differ_are_not_decidable_where_one_stands_for_both(rows: tuple[str, ...]) -> None:
    sequence = simulate(replace(DRIVE, duration_s=4.0), 0)
    seen, rig = sequence.observations, sequence.rig
    u_left, u_right, v = seen.uv_px.T
    tracks = {"t_ns": sequence.frames_t_ns[seen.frame], "track_id": seen.track_id, "uL": u_left, "uR": u_right}
    motion = dict(zip(own_tables.TWIST, sequence.motion.values.T, strict=True))
    numbers = {key: getattr(rig, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")}
    read = own_tables.read(
        "own",
        tracks | dict.fromkeys(rows, v),
        {"t_ns": sequence.motion.t_ns, **motion},
        {**numbers, "T_imu_cam": rig.T_imu_cam.tolist()},
    )
    np.testing.assert_allclose(read.sequence.observations.uv_px[:, 2], v)
    assert ("unknown-rows" in audit(read.sequence).undecided) == (rows == ("v",))
