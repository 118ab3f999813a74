"""Own tables: a recording comes back as it was, from files and from Python alike, and what is wrong is named."""

import gzip
import json
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
from toolkit.datasets.trajectories import tum
from toolkit.errors import DataError, OutputError
from toolkit.estimate import Trajectory
from toolkit.measurements import is_left_only
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, simulate

Refused = Callable[..., None]
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
    assert truth is not None
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
    assert read.truth is not None
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
    ("write", "pattern"),
    [
        (lambda text: text.replace(",", ";"), None),
        (lambda text: text.replace(",", "\t"), None),
        (lambda text: text.replace("\n", "\r\n"), None),
        (lambda text: "\ufeff" + text, None),
        (lambda text: "".join('"' + line.replace(",", '","') + '"\n' for line in text.splitlines()), None),
        (lambda text: "# a drive\n\n# of today\n" + text.replace("\n", "\n# next\n\n"), None),
        (lambda text: "# a drive\n#" + text, None),
        (lambda text: "".join(line + ",\n" for line in text.splitlines()), None),
        (lambda text: text.replace(",", " "), "its columns are separated by blanks; separate them by commas"),
        (lambda text: text.replace(",", ";").replace(".", ","), r"line 2: .* is \d+,\d+, .* with a decimal point"),
        (lambda text: text.partition("\n")[2], "holds numbers and no names; its first line names the columns"),
        (lambda text: text.replace("000000,", ","), "t_ns must be in nanoseconds, but the stamps look like"),
        (lambda text: text.replace(".", "_"), r"line 2: .* is .*_.*, expected a number"),
        (lambda text: "# a drive\n\n" + text.replace(".", "x"), r"line 4: .* is .*x.*, expected a number"),
    ],
)
def test_tables_as_spreadsheets_write_them_are_read_or_reported(
    tmp_path: Path, assert_refused: Refused, write: Callable[[str], str], pattern: str | None
) -> None:
    folder = written(recorded("twist"), tmp_path / "own")
    path, expected = folder / "tracks.csv", toolkit.load_sequence(str(folder)).content_hash()
    path.write_text(write(path.read_text()), encoding="utf-8")
    if pattern is None:
        assert toolkit.load_sequence(str(folder)).content_hash() == expected
    else:
        assert_refused(lambda: toolkit.load_sequence(str(folder)), path, pattern)


def test_without_a_stated_noise_a_twist_has_that_of_its_scatter(tmp_path: Path) -> None:
    rig = rig_of(recorded("twist"))
    del rig["noise"]
    read = own_tables.read("own", **tables_of(recorded("twist")), rig=rig).sequence
    assert all((np.asarray(value) > 0.0).all() for value in vars(read.noise).values())


TRACKS = [
    ("track_id", "trackid", r"missing column track_id \(rename trackid\?\); it has t_ns, trackid"),
    ("\n", "\n7,", r"line 2 has 6 columns, expected 5|line 2 has 7 columns, expected 6"),
    ("uL", "uR", "a column name is there twice"),
    ("t_ns,", "t,", "must be in seconds, but the stamps look like nanoseconds"),
]


@pytest.mark.parametrize(("before", "after", "pattern"), TRACKS)
def test_a_wrong_table_is_named_with_its_column(
    tmp_path: Path, assert_refused: Refused, before: str, after: str, pattern: str
) -> None:
    folder = written(recorded("imu"), tmp_path / "own")
    path = folder / "tracks.csv"
    path.write_text(path.read_text().replace(before, after, 1))
    assert_refused(lambda: toolkit.load_sequence(str(folder)), path, pattern)


@pytest.mark.parametrize(
    ("row", "column", "value", "pattern"),
    [
        (4, 1, "x", "line 5: track_id is x, expected a whole number"),
        (4, 1, "1.5", "line 5: track_id is 1.5, expected a whole number"),
        (6, 2, "", "line 7: uL is empty, expected a number"),
        (3, 0, "never", "line 4: t_ns is never, expected a whole number"),
        (3, 0, "1" * 30, "line 4: t_ns is 1+, expected a whole number of at most 9223372036854775807"),
    ],
)
def test_a_wrong_cell_is_named_with_its_line(
    tmp_path: Path, assert_refused: Refused, row: int, column: int, value: str, pattern: str
) -> None:
    folder = written(recorded("imu"), tmp_path / "own")
    path = folder / "tracks.csv"
    lines = path.read_text().splitlines()
    cells = lines[row].split(",")
    cells[column] = value
    path.write_text("\n".join([*lines[:row], ",".join(cells), *lines[row + 1 :]]))
    assert_refused(lambda: toolkit.load_sequence(str(folder)), path, pattern)


@pytest.mark.parametrize(
    ("before", "after", "pattern"),
    [
        ("baseline_m", "baseline", "there is no baseline; did you mean baseline_m"),
        ("accel_noise_density", "acc_noise_density", "there is no noise.acc_noise_density; did you mean"),
        ("fx_px = ", "fx_px = -", "fx_px is -.*, expected a positive number"),
        ("fx_px = ", "f_px = ", "there is no f_px; did you mean fx_px"),
        ("fx_px = ", f"fx_px = 1{400 * '0'} #", "fx_px is inf, expected a finite number"),
        ("T_imu_cam = [[", "T_imu_cam = [[{}], [", "T_imu_cam holds text, expected real numbers"),
        ("cy_px = ", "cy_px = '", "is not TOML"),
        ("T_imu_cam = [[", "T_imu_cam = [[7.0, ", "T_imu_cam"),
        ("T_imu_cam = [[", "T_imu_cam = [[1, 2, 3, 4], [", "T_imu_cam"),
        ("gyro_random_walk", "#", "missing noise.gyro_random_walk; an IMU's data sheet has them"),
    ],
)
def test_a_wrong_calibration_is_named_with_its_key(
    tmp_path: Path, assert_refused: Refused, before: str, after: str, pattern: str
) -> None:
    folder = written(recorded("imu"), tmp_path / "own")
    path = folder / "rig.toml"
    path.write_text(path.read_text().replace(before, after, 1))
    assert_refused(lambda: toolkit.load_sequence(str(folder)), path, pattern)


def test_a_track_twice_in_a_frame_is_refused(tmp_path: Path, assert_refused: Refused) -> None:
    folder = written(recorded("imu"), tmp_path / "own")
    path = folder / "tracks.csv"
    path.write_text(path.read_text() + path.read_text().splitlines()[3] + "\n")
    assert_refused(lambda: toolkit.load_sequence(str(folder)), path, "is there twice in its frame")


def test_values_given_in_python_are_named_too(tmp_path: Path) -> None:
    sequence = recorded("twist")
    given = {**tables_of(sequence), "rig": rig_of(sequence)}
    shorter = {**given["tracks"], "uL": given["tracks"]["uL"][:-1]}
    for wrong, pattern in (
        ({"tracks": shorter}, "tracks: its columns differ in length: t_ns"),
        ({"tracks": np.zeros((3, 4))}, "tracks: is no mapping of column names to values"),
        ({"motion": {"t_ns": [1]}}, "motion: missing column ax, ay, az, gx, gy, gz of an IMU, or vx, .* of a twist"),
        (
            {"motion": {"t_ns": [1], **{name: [0.0] for name in ("vx", "vy", "vz", "gx", "gy", "gz")}}},
            "motion: missing column ax, .* of an IMU, or vx, .* of a twist; it has t_ns, vx",
        ),
        ({"rig": {}}, "rig: missing fx_px, fy_px"),
        ({"truth": {"t": [1.0]}}, "truth: missing column x, y"),
        ({"tracks": {**given["tracks"], "uL": given["tracks"]["uL"] + 0j}}, "tracks: column uL holds complex numbers"),
    ):
        with pytest.raises(DataError, match=pattern):
            toolkit.save(tmp_path / "own", **(given | wrong))
    assert not (tmp_path / "own").exists()


def test_nothing_of_anybody_is_written_over(tmp_path: Path) -> None:
    sequence = recorded("twist")
    (tmp_path / "own").mkdir()
    (tmp_path / "own/thesis.txt").touch()
    with pytest.raises(OutputError, match="holds other files"):
        toolkit.save(tmp_path / "own", **tables_of(sequence), rig=rig_of(sequence))


def test_a_folder_with_a_table_missing_is_reported_with_its_name(tmp_path: Path) -> None:
    folder = written(recorded("imu"), tmp_path / "own")
    (folder / "imu.csv").unlink()
    with pytest.raises(DataError, match=r"missing imu\.csv or twist\.csv"):
        toolkit.load_sequence(str(folder))


def test_a_folder_named_by_a_dot_has_its_own_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(written(recorded("imu"), tmp_path / "own"))
    assert toolkit.load_sequence(".").name == "own"


def test_what_is_saved_says_it_is_of_own_tables(tmp_path: Path) -> None:
    sequence = recorded("twist")
    saved = toolkit.save(tmp_path / "own", **tables_of(sequence), rig=rig_of(sequence))
    assert json.loads((saved / "recording.json").read_text())["provenance"]["format"] == "own-tables"


@pytest.mark.parametrize("rows", [("v",), ("vL", "vR")], ids=["one row", "two rows"])
def test_an_empty_right_image_is_a_sighting_by_the_left_one(tmp_path: Path, rows: tuple[str, ...]) -> None:
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    folder = written(sequence, tmp_path / "mine")
    header, *lines = (folder / "tracks.csv").read_text().splitlines()
    assert header == "t_ns,track_id,uL,uR,vL,vR"
    if rows == ("v",):
        header, lines = header.removesuffix(",vL,vR") + ",v", [line.rpartition(",")[0] for line in lines]
    cells = lines[3].split(",")
    cells[3] = ""
    if len(rows) == 2:
        cells[5] = ""
    lines[3] = ",".join(cells)
    (folder / "tracks.csv").write_text("\n".join([header, *lines]) + "\n")
    uv_px = own_tables.load(folder).observations.uv_px
    np.testing.assert_array_equal(is_left_only(uv_px), np.arange(len(uv_px)) == 3)
    np.testing.assert_array_equal(uv_px[3, [0, 2]], sequence.observations.uv_px[3, [0, 2]])
    other = np.arange(len(uv_px)) != 3
    np.testing.assert_array_equal(uv_px[other], sequence.observations.uv_px[other])


@pytest.mark.parametrize("lacking", ["uR", "vR"])
def test_half_a_right_image_is_none_and_the_left_one_is_used(tmp_path: Path, lacking: str) -> None:
    sequence = recorded("twist")
    given, seen = tables_of(sequence), sequence.observations
    missing = np.arange(len(seen)) % 3 == 0
    tracks = {**given["tracks"], lacking: np.where(missing, np.nan, given["tracks"][lacking])}
    saved = toolkit.save(tmp_path / "own", tracks=tracks, motion=given["motion"], rig=rig_of(sequence))
    uv_px = toolkit.load_sequence(saved).observations.uv_px
    np.testing.assert_array_equal(is_left_only(uv_px), missing)
    assert np.isfinite(uv_px[:, [0, 2]]).all()


def test_a_value_that_is_masked_is_none(tmp_path: Path) -> None:
    sequence = recorded("twist")
    given = tables_of(sequence)
    masked = np.arange(len(sequence.observations)) % 5 == 0
    right = np.ma.masked_array(np.where(masked, 1.0, given["tracks"]["uR"]), masked)
    rig = rig_of(sequence)
    saved = toolkit.save(tmp_path / "own", tracks={**given["tracks"], "uR": right}, motion=given["motion"], rig=rig)
    np.testing.assert_array_equal(is_left_only(toolkit.load_sequence(saved).observations.uv_px), masked)


def test_a_recording_without_motion_samples_is_refused_as_that(tmp_path: Path) -> None:
    sequence = recorded("twist")
    given = tables_of(sequence)
    none = {name: column[:0] for name, column in given["motion"].items()}
    saved = toolkit.save(tmp_path / "own", tracks=given["tracks"], motion=none, rig=rig_of(sequence))
    with pytest.raises(DataError, match="it has no motion samples"):
        toolkit.compare(saved, "dead-reckoning", workers=1)


@pytest.mark.parametrize("filler", [-1.0, 0.0, -999.0])
def test_a_right_image_written_as_a_place_outside_of_it_is_none(tmp_path: Path, filler: float) -> None:
    sequence = recorded("twist")
    given, seen = tables_of(sequence), sequence.observations
    missing = np.arange(len(seen)) % 3 == 0
    filled = {name: np.where(missing, filler, given["tracks"][name]) for name in ("uR", "vR")}
    rig = rig_of(sequence)
    saved = toolkit.save(tmp_path / "own", tracks={**given["tracks"], **filled}, motion=given["motion"], rig=rig)
    uv_px = toolkit.load_sequence(saved).observations.uv_px
    np.testing.assert_array_equal(is_left_only(uv_px), missing)
    np.testing.assert_allclose(uv_px[:, [0, 2]], seen.uv_px[:, [0, 2]], rtol=0.0, atol=1e-12)  # v is a mean of two
