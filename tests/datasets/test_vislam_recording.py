"""The project's own format: what goes out comes back, whole or not at all, and damage is named in one line."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets import vislam_recording
from toolkit.errors import OutputError
from toolkit.motion_samples import ImuSamples, TwistSamples
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, SCENARIOS, simulate

DATA = Path(__file__).parents[2] / "data"


@pytest.fixture(scope="module")
def drive() -> Sequence:
    return simulate(replace(DRIVE, duration_s=1.0), 2)


@pytest.fixture(scope="module")
def flight() -> Sequence:
    return simulate(replace(FLIGHT, duration_s=1.0), 2)


def assert_same(one: Sequence, other: Sequence) -> None:
    assert one.content_hash() == other.content_hash()
    assert (one.name, one.provenance, one.motion_kind) == (other.name, other.provenance, other.motion_kind)


@pytest.mark.parametrize("stated", [None, {"white_px": [0.1] * 3, "walk_px": [0.2] * 3, "offset_px": [0.0] * 3}])
def test_a_noise_of_tracks_that_an_earlier_version_kept_is_passed_over(
    drive: Sequence, tmp_path: Path, stated: dict[str, list[float]] | None
) -> None:
    vislam_recording.save(drive, tmp_path / "drive")
    text = json.loads((tmp_path / "drive/recording.json").read_text())
    text["rig"]["track_noise"] = stated
    (tmp_path / "drive/recording.json").write_text(json.dumps(text))
    assert_same(vislam_recording.load(tmp_path / "drive"), drive)


def with_faults(sequence: Sequence) -> Sequence:
    uv_px = sequence.observations.uv_px.copy()
    uv_px[3, 1] = np.nan
    seen = replace(sequence.observations, uv_px=uv_px)
    return replace(sequence, observations=seen, frames_t_ns=sequence.frames_t_ns[::-1].copy())


def of_poses_alone(sequence: Sequence) -> Sequence:
    truth = replace(sequence.truth, v_world=None, bias=None, independent=False)
    return replace(sequence, prior=None, truth=truth)


def paired_otherwise(sequence: Sequence) -> Sequence:
    assert isinstance(sequence.motion, ImuSamples | TwistSamples)
    other = "middle" if isinstance(sequence.motion, ImuSamples) else "mean"
    return replace(sequence, motion=replace(sequence.motion, pairing=other), gravity_world=np.array([0.0, 9.8, 0.0]))


@pytest.mark.parametrize(
    "change",
    [
        lambda sequence: sequence,
        lambda sequence: replace(sequence, prior=None, truth=None),
        of_poses_alone,
        paired_otherwise,
        with_faults,
    ],
)
def test_a_round_trip_changes_no_bit(
    drive: Sequence, flight: Sequence, tmp_path: Path, change: Callable[[Sequence], Sequence]
) -> None:
    for sequence in map(change, (drive, flight)):
        vislam_recording.save(sequence, tmp_path / sequence.name)
        assert_same(vislam_recording.load(tmp_path / sequence.name), sequence)
        assert_same(vislam_recording.load(tmp_path / sequence.name / "recording.json"), sequence)


def test_only_recordings_are_recognised(drive: Sequence, tmp_path: Path) -> None:
    vislam_recording.save(drive, tmp_path / "drive")
    (tmp_path / "recording.json").write_text('{"schema": "another.recording/1"}')
    inside = ("drive", "drive/recording.json", "drive/recording.npz", ".", "absent", "recording.json")
    assert [name for name in inside if vislam_recording.recognises(tmp_path / name)] == [
        "drive",
        "drive/recording.json",
    ]


@pytest.mark.parametrize("interrupted", ["numpy.savez_compressed", "json.dumps", "pathlib.Path.rename"])
def test_an_interruption_leaves_what_was_there(
    interrupted: str, drive: Sequence, flight: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    vislam_recording.save(drive, tmp_path / "old")
    with monkeypatch.context() as patched:
        patched.setattr(interrupted, interrupt)
        for name in ("old", "new"):
            with pytest.raises(KeyboardInterrupt):
                vislam_recording.save(flight, tmp_path / name)
    assert [entry.name for entry in tmp_path.iterdir()] == ["old"]
    assert_same(vislam_recording.load(tmp_path / "old"), drive)


def test_a_folder_with_other_things_is_not_touched(drive: Sequence, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        vislam_recording.save(drive, tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    (tmp_path / "other").mkdir()
    (tmp_path / "other/recording.json").write_text('{"tracks": 4}')  # of another program
    with pytest.raises(OutputError, match=r"recording\.json"):
        vislam_recording.save(drive, tmp_path / "other")


@pytest.mark.parametrize(("scenario", "duration_s"), [("drive", 20.0), ("flight", 8.0)])
def test_the_committed_recordings_are_the_simulators(scenario: str, duration_s: float) -> None:
    folder = DATA / f"{scenario}_small"
    assert sum(file.stat().st_size for file in folder.iterdir()) <= 300_000
    committed = vislam_recording.load(folder)
    fresh = simulate(replace(SCENARIOS[scenario], duration_s=duration_s), 0)
    assert committed.provenance == fresh.provenance
    np.testing.assert_array_equal(committed.observations.track_id, fresh.observations.track_id)
    # Another processor's sine may differ in the last bit and so round a pixel to the next step of 1/256 px.
    np.testing.assert_allclose(committed.observations.uv_px, fresh.observations.uv_px, atol=2.0**-7)
    np.testing.assert_allclose(committed.motion.values, fresh.motion.values, atol=1e-9)
    np.testing.assert_allclose(committed.truth.T_world_imu, fresh.truth.T_world_imu, atol=1e-9)
