"""The project's own format: what goes out comes back, whole or not at all, and damage is named in one line."""

import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.datasets import load_sequence, vislam_recording
from toolkit.errors import DataError, OutputError
from toolkit.motion_samples import TwistSamples
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


def test_a_round_trip_changes_no_bit(drive: Sequence, flight: Sequence, tmp_path: Path) -> None:
    for sequence in (drive, flight):
        vislam_recording.save(sequence, tmp_path / sequence.name)
        assert_same(vislam_recording.load(tmp_path / sequence.name), sequence)
        assert_same(vislam_recording.load(tmp_path / sequence.name / "recording.json"), sequence)


def test_what_is_optional_may_be_absent(flight: Sequence, tmp_path: Path) -> None:
    assert flight.truth is not None
    poses_only = replace(flight, prior=None, truth=replace(flight.truth, v_world=None, bias=None, independent=False))
    for name, sequence in (("poses", poses_only), ("none", replace(flight, prior=None, truth=None))):
        vislam_recording.save(sequence, tmp_path / name)
        assert_same(vislam_recording.load(tmp_path / name), sequence)


@pytest.mark.parametrize("stated", [None, {"white_px": [0.1] * 3, "walk_px": [0.2] * 3, "offset_px": [0.0] * 3}])
def test_a_noise_of_tracks_that_an_earlier_version_kept_is_passed_over(
    drive: Sequence, tmp_path: Path, stated: dict[str, list[float]] | None
) -> None:
    vislam_recording.save(drive, tmp_path / "drive")
    edit_text(lambda t: t["rig"].update(track_noise=stated))(tmp_path / "drive")
    assert_same(vislam_recording.load(tmp_path / "drive"), drive)


def test_pairing_and_gravity_come_back(drive: Sequence, tmp_path: Path) -> None:
    assert isinstance(drive.motion, TwistSamples)
    changed = replace(drive, motion=replace(drive.motion, pairing="mean"), gravity_world=np.array([0.0, 9.80665, 0.0]))
    vislam_recording.save(changed, tmp_path / "changed")
    loaded = vislam_recording.load(tmp_path / "changed")
    assert isinstance(loaded.motion, TwistSamples)
    assert loaded.motion.pairing == "mean"
    assert_same(loaded, changed)


def test_faults_for_the_audit_survive(drive: Sequence, tmp_path: Path) -> None:
    uv_px = drive.observations.uv_px.copy()
    uv_px[3, 1] = np.nan
    faulty = replace(
        drive, observations=replace(drive.observations, uv_px=uv_px), frames_t_ns=drive.frames_t_ns[::-1].copy()
    )
    vislam_recording.save(faulty, tmp_path / "faulty")
    assert_same(vislam_recording.load(tmp_path / "faulty"), faulty)


def test_only_recordings_are_recognised(drive: Sequence, tmp_path: Path) -> None:
    vislam_recording.save(drive, tmp_path / "drive")
    assert vislam_recording.recognises(tmp_path / "drive")
    assert vislam_recording.recognises(tmp_path / "drive" / "recording.json")
    assert not vislam_recording.recognises(tmp_path)
    assert not vislam_recording.recognises(tmp_path / "absent")
    assert not vislam_recording.recognises(tmp_path / "drive" / "recording.npz")
    (tmp_path / "recording.json").write_text('{"schema": "another.recording/1"}')
    assert not vislam_recording.recognises(tmp_path)


def test_the_arrays_by_themselves_are_a_part_of_a_recording(drive: Sequence, tmp_path: Path) -> None:
    vislam_recording.save(drive, tmp_path / "drive")
    with pytest.raises(DataError, match=r"is a part of a recording: name the whole recording, .*drive; "):
        load_sequence(str(tmp_path / "drive" / "recording.npz"))


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


def test_an_interruption_between_the_two_moves_puts_the_old_one_back(
    drive: Sequence, flight: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vislam_recording.save(drive, tmp_path / "old")
    rename = Path.rename

    def interrupt_second(self: Path, target: Path) -> Path:
        if ".partial-" in self.name:
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupt_second)
    with pytest.raises(KeyboardInterrupt):
        vislam_recording.save(flight, tmp_path / "old")
    assert_same(vislam_recording.load(tmp_path / "old"), drive)


def test_a_folder_with_other_things_is_not_touched(drive: Sequence, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        vislam_recording.save(drive, tmp_path)
    with pytest.raises(OutputError, match="is not a directory"):
        vislam_recording.save(drive, tmp_path / "thesis.tex")
    with pytest.raises(OutputError, match="cannot be written"):
        vislam_recording.save(drive, tmp_path / "thesis.tex" / "below")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    (tmp_path / "other").mkdir()
    (tmp_path / "other/recording.json").write_text('{"tracks": 4}')  # of another program
    with pytest.raises(OutputError, match=r"recording\.json"):
        vislam_recording.save(drive, tmp_path / "other")


def edit_text(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        file = folder / "recording.json"
        text = json.loads(file.read_text())
        change(text)
        file.write_text(json.dumps(text))

    return damage


def edit_arrays(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        with np.load(folder / "recording.npz") as archive:
            arrays = dict(archive)
        change(arrays)
        np.savez_compressed(folder / "recording.npz", **arrays)

    return damage


def truncate(folder: Path) -> None:
    whole = (folder / "recording.npz").read_bytes()
    (folder / "recording.npz").write_bytes(whole[: len(whole) // 2])


def flip_bits(folder: Path) -> None:
    whole = bytearray((folder / "recording.npz").read_bytes())
    with zipfile.ZipFile(folder / "recording.npz") as archive:
        begin = archive.getinfo("observations_uv_px.npy").header_offset
    for i in range(begin + 200, begin + 230):
        whole[i] ^= 0xFF
    (folder / "recording.npz").write_bytes(bytes(whole))


def wrong_frame(arrays: dict[str, Any]) -> None:
    arrays["observations_frame"][-1] = 99


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no arrays": (lambda f: (f / "recording.npz").unlink(), "No such file"),
    "text cut short": (lambda f: (f / "recording.json").write_text('{"schema": "vislam'), "cannot be read as JSON"),
    "text is a list": (lambda f: (f / "recording.json").write_text("[]"), "has not the schema"),
    "later schema": (edit_text(lambda t: t.update(schema="vislam.recording/9")), "vislam.recording/9"),
    "no rig": (edit_text(lambda t: t.pop("rig")), "lacks `?rig"),
    "focal length beyond any": (edit_text(lambda t: t["rig"].update(fx_px=10**400)), "does not fit"),
    "extrinsic is 3x3": (edit_text(lambda t: t["rig"].update(T_imu_cam=np.eye(3).tolist())), "T_imu_cam"),
    "unknown motion": (edit_text(lambda t: t["motion"].update(kind="gps")), "gps"),
    "unknown pairing": (edit_text(lambda t: t["motion"].update(pairing="middle")), "middle"),
    "truncated archive": (truncate, "damaged"),
    "flipped bits": (flip_bits, "damaged"),
    "a bare array": (lambda f: np.save((f / "recording.npz").open("wb"), np.eye(3)), "damaged"),
    "pickled array": (edit_arrays(lambda a: a.update(motion_values=np.array([{}], dtype=object))), "never unpickled"),
    "missing array": (edit_arrays(lambda a: a.pop("frames_t_ns")), "frames_t_ns is missing"),
    "motion of five columns": (
        edit_arrays(lambda a: a.update(motion_values=a["motion_values"][:, :5])),
        "motion_values",
    ),
    "columns of different length": (
        edit_arrays(lambda a: a.update(observations_track_id=a["observations_track_id"][1:])),
        "differ in length",
    ),
    "arrays of another recording": (
        edit_arrays(lambda a: a.update(frames_t_ns=a["frames_t_ns"][:-1])),
        "copy both files again",
    ),
    "observation of no frame": (edit_arrays(wrong_frame), "is of frame 99"),
    "facts that are no text": (
        edit_text(lambda t: t["provenance"].update(facts=[3])),
        "provenance.facts.0.: expected string",
    ),
    "imaginary part": (edit_arrays(lambda a: a.update(motion_values=a["motion_values"] * 1j)), "holds complex128"),
    "start without a covariance": (edit_arrays(lambda a: a.update(prior_cov=-a["prior_cov"])), "not positive definite"),
    "unsorted observations": (
        edit_arrays(lambda a: a.update(observations_frame=a["observations_frame"][::-1])),
        "not sorted",
    ),
}


@pytest.mark.parametrize(("damage", "expected"), DAMAGES.values(), ids=DAMAGES)
def test_damage_is_named_in_one_line(
    damage: Callable[[Path], object], expected: str, drive: Sequence, tmp_path: Path
) -> None:
    folder = tmp_path / "drive"
    vislam_recording.save(drive, folder)
    damage(folder)
    with pytest.raises(DataError, match=expected) as caught:
        vislam_recording.load(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message


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
    assert committed.truth is not None
    assert fresh.truth is not None
    np.testing.assert_allclose(committed.truth.T_world_imu, fresh.truth.T_world_imu, atol=1e-9)
