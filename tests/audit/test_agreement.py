"""Where vision and the measured motion part, from some time on or throughout: told there and of that size, only."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.audit.conftest import LONGER_S, details, recording
from toolkit.audit import audit
from toolkit.audit.agreement import Deviation, sustained
from toolkit.simulation import faults


@pytest.mark.parametrize("seed", [0, 1])  # the two sides of the image
def test_a_narrow_view_of_a_sound_flight_is_no_disagreement_and_a_gyro_in_other_axes_is(seed: int) -> None:
    # Beside the camera's velocity, whose errors the camera's rotation compensates, the gyro's leaves up to 5 px.
    narrow, narrower = (faults.one_sided_view(recording("flight", 0), share, seed) for share in (0.75, 0.85))
    assert not any(finding.blocking for view in (narrow, narrower) for finding in audit(view).findings)
    exchanged = narrow.motion.of(narrow.motion.t_ns, narrow.motion.values[:, [0, 1, 2, 4, 3, 5]])
    assert any(finding.blocking for finding in audit(replace(narrow, motion=exchanged)).findings)


def test_a_conflict_is_reported_at_its_time_and_of_its_size() -> None:
    sound = recording("drive", 3)
    disturbed = faults.disturbed_motion(sound, 3.0, 3)
    off = np.flatnonzero(np.any(disturbed.motion.values != sound.motion.values, axis=1))
    begin_s, end_s = (disturbed.motion.t_ns[off[[0, -1]]] - sound.frames_t_ns[0]) / 1e9
    (found,) = (finding for finding in audit(disturbed).findings if finding.fault == "conflict")
    match = re.search(r"at (\d+)-(\d+) s \(by ([\d.]+) m/s", found.detail)
    assert match is not None
    # Whole seconds, and a quarter of the stretch of 2 s at either end.
    assert [float(match[1]), float(match[2])] == pytest.approx([begin_s, end_s], abs=1.0)
    assert float(match[3]) == pytest.approx(3.0, abs=0.15)
    assert found.warning and not found.blocking and not found.repaired


def test_what_scatters_all_along_is_no_conflict_and_what_stands_out_or_stays_is() -> None:
    rng, t_s, noise = np.random.default_rng(0), 0.1 * np.arange(600), np.full(3, 0.06)
    white = rng.normal(0.0, 0.05, (600, 3))
    wander = white + np.repeat(rng.normal(0.0, 0.5, (30, 3)), 20, axis=0)  # lasts 2 s each, as slip does

    def spans(value: np.ndarray, begin: int, end: int, by: float) -> list[tuple[float, float]]:
        step = by * ((np.arange(600) >= begin) & (np.arange(600) < end))[:, None] * [1.0, 0.0, 0.0]
        found = sustained(Deviation("velocity", "m/s", t_s, value + step, noise, False), 10.0, 0.2)
        return [(span.begin_s, span.end_s) for span in found]

    assert spans(wander, 0, 0, 0.0) == []
    assert spans(wander, 300, 350, 9.0)[0] == pytest.approx((30.0, 35.0), abs=1.0)
    assert spans(white, 300, 600, 1.0)[0][0] == pytest.approx(30.0, abs=1.0)


@pytest.mark.parametrize("every", [4, 5])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_frames_without_a_sighting_now_and_then_leave_too_little_to_compare_and_no_warning_of_numpy(every: int) -> None:
    """No stretch of intervals is long enough for the specific force between its holes."""
    sequence = recording("drive-imu", 0, 8.0)
    seen = sequence.observations.frame % every != 0
    assert "conflict" not in details(audit(replace(sequence, observations=sequence.observations.select(seen))))


def test_a_scale_that_wanders_hides_a_step_and_the_audit_says_how_large_a_one() -> None:
    clean = recording("drive")
    t_s = (clean.motion.t_ns - clean.motion.t_ns[0]) / 1e9
    wanders = 1.0 + 0.04 * np.sin(2.0 * np.pi * t_s / 7.0)[:, None] * (np.arange(6) < 3)
    reported = audit(replace(clean, motion=clean.motion.of(clean.motion.t_ns, wanders * clean.motion.values)))
    found = re.search(r"a step by less than (\d+) % would not show", reported.undecided["scale-change"])
    assert found is not None and 8 <= int(found[1]) <= 20
    assert "scale-change" not in audit(clean).undecided


@pytest.mark.parametrize("scenario", LONGER_S)
def test_an_image_that_jumps_and_stays_is_reported_at_its_time(scenario: str) -> None:
    faulty = faults.jumped_image(recording(scenario), 15.0)
    found = re.search(r"at ([\d.]+) s \(by ([\d.]+) rad\)", details(audit(faulty))["image-jump"])
    assert found is not None
    assert float(found[1]) == pytest.approx(LONGER_S[scenario] / 2.0, abs=0.2)
    # A shift is a rotation in the middle of the image only, and close points take some of it for a translation.
    assert float(found[2]) == pytest.approx(np.sqrt(2.0) * 15.0 / faulty.rig.fx_px, rel=0.35)


def test_a_rotation_that_is_over_at_once_is_no_jump_that_stays() -> None:
    clean = recording("drive")
    values = clean.motion.values.copy()
    values[60, 5] += 0.4
    assert "image-jump" not in details(audit(replace(clean, motion=clean.motion.of(clean.motion.t_ns, values))))
