"""Own tables: a recording comes back as it was, from files and from Python alike, and what is wrong is named."""

import gzip
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import toolkit
from toolkit.cli import main
from toolkit.datasets import own_tables
from toolkit.datasets.io.tables import imu_columns
from toolkit.datasets.trajectories import tum
from toolkit.estimate import Trajectory
from toolkit.measurements import is_left_only
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, simulate

NAMES = {"imu": own_tables.IMU, "twist": own_tables.TWIST}


@cache
def recorded(kind: str) -> Sequence:
    scenario = {"imu": FLIGHT, "twist": DRIVE}[kind]
    return simulate(replace(scenario, duration_s=1.0, camera=replace(scenario.camera, max_tracks=10)), 0)


def rig_of(sequence: Sequence) -> dict[str, Any]:
    rig = {key: getattr(sequence.rig, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")}
    noise = {
        key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in vars(sequence.noise).items()
    }
    T_imu_cam, sigma_px = sequence.rig.T_imu_cam.tolist(), float(np.sqrt(sequence.rig.cov_uv_px2[0, 0]))
    gravity = sequence.gravity_world.tolist()
    return {**rig, "T_imu_cam": T_imu_cam, "pixel_sigma_px": sigma_px, "gravity_world": gravity, "noise": noise}


def tables_of(sequence: Sequence) -> dict[str, dict[str, Any]]:
    seen, (u_left, u_right, v) = sequence.observations, sequence.observations.uv_px.T
    rows = {"vL": v, "vR": v} if sequence.rig.cov_uv_px2[2, 2] < sequence.rig.cov_uv_px2[0, 0] else {"v": v}
    tracks = {"t_ns": sequence.frames_t_ns[seen.frame], "track_id": seen.track_id, "uL": u_left, "uR": u_right, **rows}
    motion = zip(NAMES[sequence.motion_kind], sequence.motion.values.T, strict=True)
    return {"tracks": tracks, "motion": {"t_ns": sequence.motion.t_ns, **dict(motion)}}


def as_csv(table: dict[str, Any]) -> str:
    rows = zip(*(np.asarray(column).tolist() for column in table.values()), strict=True)
    return "\n".join([",".join(table), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def as_toml(values: dict[str, Any]) -> str:
    noise = "".join(f"{key} = {value}\n" for key, value in values["noise"].items())
    return "".join(f"{key} = {value}\n" for key, value in values.items() if key != "noise") + f"[noise]\n{noise}"


def written(sequence: Sequence, folder: Path) -> Path:
    """Write a sequence as own tables and return their folder."""
    folder.mkdir()
    tables, truth = tables_of(sequence), sequence.truth
    (folder / "tracks.csv").write_text(as_csv(tables["tracks"]))
    (folder / f"{sequence.motion_kind}.csv").write_text(as_csv(tables["motion"]))
    (folder / "rig.toml").write_text(as_toml(rig_of(sequence)))
    (folder / "truth.tum").write_text(tum.text(Trajectory(truth.t_ns, truth.T_world_imu)))
    return folder


@pytest.mark.parametrize("kind", ["imu", "twist"])
def test_a_recording_comes_back_to_the_bit(tmp_path: Path, kind: str) -> None:
    original, read = recorded(kind), toolkit.load_sequence(str(written(recorded(kind), tmp_path / "own")))
    np.testing.assert_array_equal(read.frames_t_ns, original.frames_t_ns)
    np.testing.assert_array_equal(read.observations.uv_px, original.observations.uv_px)
    np.testing.assert_array_equal(read.observations.track_id, original.observations.track_id)
    np.testing.assert_array_equal(read.motion.values, original.motion.values)
    np.testing.assert_allclose(read.rig.cov_uv_px2, original.rig.cov_uv_px2, rtol=1e-12)
    assert {key: np.max(value) for key, value in vars(read.noise).items()} == {
        key: np.max(value) for key, value in vars(original.noise).items()
    }
    np.testing.assert_array_equal(read.truth.t_ns, original.truth.t_ns)
    assert read.provenance.format == "own-tables"


def test_the_folder_the_command_and_python_give_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = recorded("imu")
    folder = written(sequence, tmp_path / "own")
    words = ("--tracks", "tracks.csv", "--motion", "imu.csv", "--rig", "rig.toml", "--truth", "truth.tum")
    places = [str(folder / word) if not word.startswith("--") else word for word in words]
    assert main(["import", *places, "--out", str(tmp_path / "imported")]) == 0
    assert f"{sequence.frame_count} frames" in capsys.readouterr().out
    saved = toolkit.save(tmp_path / "saved", **tables_of(sequence), rig=rig_of(sequence), truth=folder / "truth.tum")
    hashes = {toolkit.load_sequence(str(path)).content_hash() for path in (folder, tmp_path / "imported", saved)}
    assert len(hashes) == 1


def test_seconds_are_exact_and_order_and_compression_do_not_matter(tmp_path: Path) -> None:
    folder = written(recorded("twist"), tmp_path / "own")
    expected = toolkit.load_sequence(str(folder)).content_hash()
    for name in ("tracks.csv", "twist.csv"):
        heading, *lines = (folder / name).read_text().splitlines()
        shuffled = [line.split(",") for line in lines]
        seconds = [f"{row[0][:-9]}.{row[0][-9:]}" for row in shuffled]
        rows = [",".join([*row[:0:-1], t, "0"]) for row, t in zip(shuffled, seconds, strict=True)]
        names = ",".join([*heading.split(",")[:0:-1], "t", "comment"])
        (folder / name).unlink()
        (folder / f"{name}.gz").write_bytes(gzip.compress("\r\n".join([names, *rows]).encode()))
    assert toolkit.load_sequence(str(folder)).content_hash() == expected
    tables = own_tables.read("own", folder / "tracks.csv.gz", folder / "twist.csv.gz", folder / "rig.toml")
    assert [name.rpartition(" ")[2] for name in tables.unused] == ["comment", "comment"]


@pytest.mark.parametrize(
    "write",
    [
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: "".join('"' + line.replace(",", '","') + '"\n' for line in text.splitlines()),
        lambda text: "# a drive\n\n# of today\n" + text.replace("\n", "\n# next\n\n"),
        lambda text: "# a drive\n#" + text.replace("\n", "\n# of today\n", 1),
        lambda text: "".join(line + ",\n" for line in text.splitlines()),
        lambda text: text.replace("\n", ",,\n").replace("vR,,", "vR,of,of", 1),
    ],
)
def test_tables_as_spreadsheets_write_them_are_read(tmp_path: Path, write: Callable[[str], str]) -> None:
    folder = written(recorded("twist"), tmp_path / "own")
    path, expected = folder / "tracks.csv", toolkit.load_sequence(str(folder)).content_hash()
    path.write_text(write(path.read_text()), encoding="utf-8")
    assert toolkit.load_sequence(str(folder)).content_hash() == expected


def test_without_a_stated_noise_a_twist_has_that_of_its_scatter(tmp_path: Path) -> None:
    rig = rig_of(recorded("twist"))
    del rig["noise"]
    read = own_tables.read("own", **tables_of(recorded("twist")), rig=rig).sequence
    assert all((np.asarray(value) > 0.0).all() for value in vars(read.noise).values())


def test_a_folder_named_by_a_dot_has_its_own_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(written(recorded("imu"), tmp_path / "own"))
    assert toolkit.load_sequence(".").name == "own"


@pytest.mark.parametrize(
    ("columns", "missing"),
    [
        (("uR",), np.nan),
        (("vR",), np.nan),
        *((("uR", "vR"), filler) for filler in (-1.0, 0.0, -999.0)),
        (("uR",), None),
        (("uR",), "masked"),
        (("uR", "vR"), " "),
    ],
    ids=["no uR", "no vR", "-1", "0", "-999", "None", "masked", "empty"],
)
def test_a_right_image_that_is_missing_leaves_the_sighting_of_the_left_one(
    tmp_path: Path, columns: tuple[str, ...], missing: float | str | None
) -> None:
    sequence = recorded("twist")
    given, seen = tables_of(sequence), sequence.observations
    lacking = np.arange(len(seen)) % 3 == 0
    for name in columns:
        masked = np.ma.masked_array(np.where(lacking, 1.0, given["tracks"][name]), lacking)
        filled = np.where(lacking, np.array(missing, dtype=object), given["tracks"][name])
        given["tracks"][name] = masked if missing == "masked" else filled
    uv_px = own_tables.read("own", **given, rig=rig_of(sequence)).sequence.observations.uv_px
    np.testing.assert_array_equal(is_left_only(uv_px), lacking)
    np.testing.assert_allclose(uv_px[:, [0, 2]], seen.uv_px[:, [0, 2]], rtol=0.0, atol=1e-12)  # v is a mean of two


@pytest.mark.parametrize(
    ("kinds", "stamp"),
    [(("acc_", "gyro_"), "timestamp [ns]"), (("a", "w"), "t_ns"), (("linear_acceleration.", "omega_"), "#ns")],
)
def test_columns_of_an_imu_go_by_many_names(tmp_path: Path, kinds: tuple[str, ...], stamp: str) -> None:
    original = recorded("imu")
    folder = written(original, tmp_path / "own")
    table, names = folder / "imu.csv", [f"{kind}{axis}" for kind in kinds for axis in "xyz"]
    table.write_text("\n".join([",".join([stamp, *names]), *table.read_text().splitlines()[1:]]) + "\n")
    np.testing.assert_array_equal(own_tables.load(folder).motion.values, original.motion.values)
    assert own_tables.read("own", folder / "tracks.csv", table, folder / "rig.toml").unused == ()


@pytest.mark.parametrize(
    ("wanted", "others"),
    [
        (("a_RS_S_", "w_RS_S_"), ("b_w_RS_S_", "b_a_RS_S_")),
        (("acc_", "gyro_"), ("gyro_bias_", "acc_bias_")),
        (("linear_acceleration.", "angular_velocity."), ("angular_acceleration.",)),
        (("linearAcceleration.", "angularVelocity."), ()),
    ],
)
def test_columns_of_other_quantities_are_not_an_imus(wanted: tuple[str, ...], others: tuple[str, ...]) -> None:
    expected = tuple(f"{name}{axis}" for name in wanted for axis in "xyz")
    assert imu_columns([f"{name}{axis}" for name in others for axis in "xyz"]) == ()
    assert imu_columns(["t", *(f"{name}{axis}" for name in others for axis in "xyz"), *expected]) == expected


@pytest.mark.parametrize("empty", ["", "nan"])
def test_sensors_with_rows_of_their_own_are_joined_at_the_gyros_stamps(tmp_path: Path, empty: str) -> None:
    original = recorded("imu")
    folder = written(original, tmp_path / "own")
    rows = [row.split(",") for row in (folder / "imu.csv").read_text().splitlines()]
    apart = [rows[0]]
    for t, *values in rows[1:]:
        apart.append([t, *[empty] * 3, *values[3:]])
        apart.append([str(int(t) + 2_000_000), *values[:3], *[empty] * 3])
    (folder / "imu.csv").write_text("\n".join(",".join(row) for row in apart) + "\n")
    read = own_tables.load(folder)
    np.testing.assert_array_equal(read.motion.values[:, 3:], original.motion.values[1:, 3:])
    accel = original.motion.values[:, :3]
    np.testing.assert_allclose(read.motion.values[:, :3], 0.4 * accel[:-1] + 0.6 * accel[1:], atol=1e-2)
    assert "samples of the accelerometer are interpolated at the" in read.provenance.facts[-1]


@pytest.mark.parametrize("unseen", [0.0, -1.0])
def test_rows_of_nothing_are_left_out_and_counted(unseen: float) -> None:
    sequence = recorded("twist")
    tables = tables_of(sequence)
    tables["tracks"] = {
        name: np.append(column, [column[0] if name == "t_ns" else 999 if name == "track_id" else unseen])
        for name, column in tables["tracks"].items()
    }
    read = own_tables.read("own", **tables, rig=rig_of(sequence)).sequence
    np.testing.assert_array_equal(read.observations.uv_px, sequence.observations.uv_px)
    assert any(fact.startswith("1 rows of tracks are 0 or -1") for fact in read.provenance.facts)
