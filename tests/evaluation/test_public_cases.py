"""Trajectories as people have them: a table of what is given and what must come of it (2 s)."""

import gzip
import json
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from tests.advice import TOOLKIT, advice_in, is_followed
from tests.evaluation.conftest import run_of, runs_in
from toolkit.datasets.trajectories import euroc, kitti, openvins, tum
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, about_z, quaternion_from_rotation, rotation_from_quaternion, se3, se3_exp, so3_exp

S = 10**9
POINT = np.zeros(3)


def turned_by(rotvec: tuple[float, float, float]) -> Array:
    return se3(so3_exp(np.array(rotvec)), POINT)


def scored(vislam: Callable[..., int], file: str = "s.tum") -> tuple[dict, dict]:
    run = run_of(vislam, file)
    return run["metrics"], run["notes"]


OF_ORIENTATION = ("ate_none_m", "ate_se3_deg", "rpe_1s_m", "rpe_100m_percent", "kitti_t_percent", "end_drift_percent")
FLIP = se3(np.diag([1.0, -1.0, -1.0]), POINT)


@pytest.mark.parametrize(
    ("world", "body", "words"),
    [
        (None, turned_by((0.0, 0.0, 0.5)), "turned by 29 deg"),
        (None, turned_by((0.0, 0.0, 1.5708)), "its x, y and z point along the truth's y, -x and z"),
        (None, turned_by((0.0, 0.0, 3.1415)), "its x, y and z point along the truth's -x, -y and z"),
        (None, turned_by((0.6, 1.2, 0.4)), "turned by 80 deg"),
        (FLIP, FLIP, "its x, y and z point along the truth's x, -y and -z"),
        (se3(about_z(np.pi / 2) @ np.diag([1.0, -1.0, -1.0]), POINT), FLIP, "the truth's x, -y and -z"),
    ],
)
def test_a_body_with_other_axes_is_named_and_only_its_positions_are_scored(scene, vislam, world, body, words) -> None:
    t_ns = scene.stamps(10.0)
    poses = (np.eye(4) if world is None else world) @ scene.estimated(t_ns, 0.07) @ body
    scene.write("s.tum", t_ns, poses)
    metrics, notes = scored(vislam)
    assert metrics["ate_se3_m"] == pytest.approx(0.07 * np.sqrt(3.0), rel=0.1)
    assert all(metrics[key] is None and words in notes[key] for key in OF_ORIENTATION)
    # Followed, the advice leads to a file that is scored whole.
    numbers = notes["ate_se3_deg"].rpartition("x y z w ")[2].partition(")")[0].split()
    T_truth_body = se3(rotation_from_quaternion(np.array(numbers, dtype=float)), POINT)
    scene.write("s.tum", t_ns, poses @ np.linalg.inv(T_truth_body))
    assert scored(vislam)[0]["ate_se3_deg"] < 2.0


def test_a_turned_body_is_named_beside_a_scale_and_on_a_line(scene, vislam) -> None:
    t_ns, body = scene.stamps(10.0), turned_by((0.6, 1.2, 0.4))
    poses = scene.estimated(t_ns, 0.02) @ body
    scene.write("s.tum", t_ns, se3(poses[:, :3, :3], 0.4 * poses[:, :3, 3]))
    assert "turned by 80 deg" in scored(vislam)[1]["ate_se3_deg"]
    # A drive along a road that hardly bends, with a sensor that looks aside.
    time_s = np.arange(600) / 10.0
    heading = 0.02 * np.sin(time_s)
    line = se3(about_z(heading), np.stack([5.0 * time_s, 0.1 * np.cos(time_s), 0.0 * time_s], axis=1))
    scene.write("truth.tum", t_ns, line)
    for turn, words in ((np.pi / 2.0, "its x, y and z point along the truth's y, -x and z"), (0.0, "")):
        scene.write("s.tum", t_ns, line @ se3_exp(noise(600)) @ turned_by((0.0, 0.0, turn)))
        metrics, notes = scored(vislam)
        assert words in notes.get("ate_se3_deg", "")
        assert (metrics["ate_se3_deg"] is None) == bool(words)


def test_an_extrinsic_that_is_a_little_off_is_told_and_scored(scene, vislam) -> None:
    t_ns = scene.stamps(10.0)
    for turn, is_told in ((0.1, True), (0.0, False)):
        scene.write("s.tum", t_ns, scene.estimated(t_ns, 0.05) @ turned_by((0.0, 0.0, turn)))
        metrics, notes = scored(vislam)
        assert ("off by one turn of 5.7 deg" in notes.get("rpe_100m_percent", "")) == is_told
        assert metrics["rpe_100m_percent"] is not None


def rows(t_ns: Array, poses: Array, row: str) -> str:
    """Lines of poses as a format says: t, x y z, qx qy qz qw, i the number of the row, n the stamp in nanoseconds.

    s and ns are its whole seconds and the rest.
    """
    quaternions = quaternion_from_rotation(poses[:, :3, :3])
    lines = []
    for i, (t, p, q) in enumerate(zip(t_ns.tolist(), poses[:, :3, 3].tolist(), quaternions.tolist(), strict=True)):
        named = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*p, *q), strict=True))
        lines.append(row.format(i=i, n=t, s=t // S, ns=t % S, t=f"{t / S:.9f}", **named))
    return "\n".join(lines) + "\n"


TUM = "{t} {x:.9f} {y:.9f} {z:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}"
COMMAS, QUATERNION = "{x:.9f},{y:.9f},{z:.9f}", "{qx:.9f},{qy:.9f},{qz:.9f},{qw:.9f}"
W_FIRST = "{qw:.9f},{qx:.9f},{qy:.9f},{qz:.9f}"
ROS = ",".join(f"field.pose.position.{axis}" for axis in "xyz")


@pytest.mark.parametrize(
    ("heading", "row"),
    [
        ("num, t, x, y, z, qx, qy, qz, qw", f"{{i}},{{t}},{COMMAS},{QUATERNION}"),
        ("index, timestamp [ns], x, y, z, qx, qy, qz, qw", f"{{i}},{{n}},{COMMAS},{QUATERNION}"),
        ("timestamp,tx,ty,tz,qw,qx,qy,qz", f"{{t}},{COMMAS},{W_FIRST}"),
        ("#timestamp [s],p_x [m],p_y [m],p_z [m],q_x,q_y,q_z,q_w", f"{{t}},{COMMAS},{QUATERNION}"),
        ("# time x y z qw qx qy qz", TUM.replace("{qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}", W_FIRST.replace(",", " "))),
        ("timestamp tx ty tz qx qy qz qw", TUM),
        ("t;qw;qx;qy;qz;px;py;pz", f"{{t}},{W_FIRST},{COMMAS}".replace(",", ";")),
        (
            f"%time,field.header.seq,{ROS},{ROS.replace('position', 'orientation')},field.pose.orientation.w",
            f"{{n}},{{i}},{COMMAS},{QUATERNION}",
        ),
        ("# timestamp x y z qx qy qz qw", TUM),
        ("sec,nsec,x,y,z,qx,qy,qz,qw", f"{{s}},{{ns}},{COMMAS},{QUATERNION}"),
        ("", TUM),
    ],
)
def test_columns_are_read_by_their_names(scene, vislam, heading: str, row: str) -> None:
    t_ns = scene.stamps(4.0)
    Path("s.csv").write_text(f"{heading}\n" * bool(heading) + rows(t_ns, scene.estimated(t_ns, 0.07), row))
    metrics, _ = scored(vislam, "s.csv")
    assert metrics["pairs"] == 240
    assert metrics["ate_se3_m"] == pytest.approx(0.07 * np.sqrt(3.0), rel=0.15)
    assert metrics["ate_se3_deg"] < 2.0


@pytest.mark.parametrize(
    ("row", "heading"),
    [
        (TUM[: TUM.index("{qx")] + "0 0 0 1", ""),
        (TUM[: TUM.index("{qx")] + "0 0 0 0", ""),
        (TUM[: TUM.index("{qx")] + "nan nan nan nan", ""),
        ("{t} {x:.9f} {y:.9f} {z:.9f}", ""),
        (f"{{t}},{COMMAS}", ""),
        (f"{{n}},{COMMAS}", "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]"),
        (f"{{t}},{COMMAS},0.01,0.01,0.02,4", "t,x,y,z,sx,sy,sz,status"),
    ],
)
def test_a_truth_of_positions_alone_scores_positions_and_nothing_else(scene, vislam, row: str, heading: str) -> None:
    t_ns = scene.stamps(2.0)
    Path("truth.tum").write_text(f"{heading}\n" * bool(heading) + rows(t_ns, scene.poses_at(t_ns), row))
    for name in ("s", "results/truth"):
        scene.write(f"{name}.tum", scene.stamps(10.0), scene.estimated(scene.stamps(10.0), 0.07))
    metrics, notes = scored(vislam)
    assert metrics["ate_se3_m"] == pytest.approx(0.07 * np.sqrt(3.0), rel=0.15)
    assert all(metrics[key] is None for key in OF_ORIENTATION)
    assert "the truth is of positions alone" in notes["ate_se3_deg"]
    assert vislam("baseline", "--trajectories", "results", "--truth", "truth=truth.tum", "--out", "b.json") == 0
    assert list(json.loads(Path("b.json").read_text())["bounds"]) == ["ate_se3_m"]
    assert vislam("check", "--baseline", "b.json", "--trajectories", "results") == 0


def test_the_point_of_an_antenna_is_named_where_it_explains_more_than_a_clock(scene, vislam) -> None:
    """On a loop that is no circle: on one, an antenna ahead of the body is the body a little later."""
    t_ns, point, time_s = scene.stamps(10.0), np.array([0.4, -0.3, 0.8]), np.arange(600) / 10.0
    angles = np.stack([0.5 * np.sin(1.3 * time_s), 0.4 * np.cos(0.9 * time_s), 2.0 * np.sin(0.5 * time_s)], axis=1)
    at = np.stack([9.0 * np.sin(0.2 * time_s), 6.0 * np.sin(0.31 * time_s), np.sin(0.7 * time_s)], axis=1)
    body = se3(so3_exp(angles), at)
    estimate = body @ se3_exp(0.005 * np.random.default_rng(0).standard_normal((600, 6)))
    scene.write("s.tum", t_ns, scene.own_world @ estimate)
    Path("truth.tum").write_text(rows(t_ns, body @ se3(np.eye(3), point), "{t} {x:.9f} {y:.9f} {z:.9f}"))
    note = scored(vislam)[1]["ate_se3_m"]
    found = np.array(note.partition("at the point (")[2].partition(")")[0].split(","), dtype=float)
    np.testing.assert_allclose(found, point, atol=0.005)
    # A late truth is the clock's.
    scene.write("truth.tum", t_ns + 80_000_000, body)
    notes = scored(vislam)[1]
    assert "its stamps shifted by 79.9 +- 0.2 ms" in notes["clock_offset_ms"]
    assert "point" not in notes.get("ate_se3_m", "")


def test_lines_of_a_truth_that_hold_no_pose_are_left_out_and_counted(scene, vislam, capsys) -> None:
    lines = Path("truth.tum").read_text().splitlines()
    for at, values in ((7, " nan" * 7), (8, " 1 2 3 0 0 0 0")):
        lines[at] = lines[at].split()[0] + values
    Path("truth.tum").write_text("\n".join(lines) + "\n")
    scene.write("s.tum", scene.stamps(10.0), scene.estimated(scene.stamps(10.0), 0.07))
    assert vislam("evaluate", "truth.tum", "s.tum", "--out", "out") == 0
    assert "left out of the truth: 2 of 1200 lines hold a value that is not finite" in capsys.readouterr().out


def test_control_points_are_few_and_far_apart(scene, vislam) -> None:
    t_ns, ours = scene.stamps(1.0 / 45.0, 5.0, 300.0), scene.stamps(10.0, 0.0, 300.0)
    for start in (0, t_ns[0]):
        Path("truth.tum").write_text(rows(t_ns - start, scene.poses_at(t_ns), "{t} {x:.9f} {y:.9f} {z:.9f}"))
        scene.write("s.tum", ours - start, scene.estimated(ours, 0.05))
        assert scored(vislam)[0]["pairs"] == 7


def test_poses_of_kitti_have_the_stamps_beside_them(scene, vislam) -> None:
    t_ns = scene.stamps(10.0)
    Path("poses.txt").write_text(kitti.text(Trajectory(t_ns, scene.poses_at(t_ns))))
    scene.write("s.tum", t_ns[::3] - t_ns[0], scene.estimated(t_ns[::3], 0.07))
    assert vislam("evaluate", "poses.txt", "s.tum", "--quiet") == 3
    Path("times.txt").write_text("".join(f"{(t - t_ns[0]) / S:e}\n" for t in t_ns.tolist()))
    assert vislam("evaluate", "poses.txt", "s.tum", "--out", "out", "--quiet") == 0
    assert runs_in()[0]["metrics"]["pairs"] == 200


def test_gzipped_trajectories_are_read(scene, vislam) -> None:
    t_ns = scene.stamps(4.0)
    for name in ("truths/A.tum", "results/good/A/1.tum", "results/good/A/2.tum"):
        written = scene.write(name, t_ns, scene.poses_at(t_ns))
        Path(f"{name}.gz").write_bytes(gzip.compress(written.read_bytes()))
        written.unlink()
    assert vislam("evaluate", "truths", "results", "--out", "out", "--quiet") == 0
    assert {(run["sequence"], run["run"]) for run in runs_in()} == {("A", "1"), ("A", "2")}


Lines = Callable[[list[str]], list[str]]


def stamped(by: Callable[[Decimal], object]) -> Lines:
    """Change the stamps, exactly."""
    return lambda lines: [f"{by(Decimal(t))} {rest}" for t, _, rest in (line.partition(" ") for line in lines)]


def ordered(mark: str, *order: int) -> Lines:
    """Exchange the columns."""
    return lambda lines: [mark.join(line.split(mark)[i] for i in order) for line in lines]


def poses_of(lines: list[str]) -> tuple[Array, Array, Array]:
    """Return stamps (N,) ns, positions (N, 3) and rotations (N, 3, 3)."""
    table = np.array([line.split()[1:8] for line in lines], dtype=float)
    stamps_ns = np.array([int(Decimal(line.split()[0]) * S) for line in lines])
    return stamps_ns, table[:, :3], rotation_from_quaternion(table[:, 3:])


def as_rows(row: str, change: Callable[[Array], Array] = lambda poses: poses) -> Lines:
    """Write the poses of lines in another format, or other poses on their stamps."""

    def written(lines: list[str]) -> list[str]:
        stamps_ns, positions, rotations = poses_of(lines)
        return rows(stamps_ns, change(se3(rotations, positions)), row).splitlines()

    return written


def posed(change: Callable[[Array], Array]) -> Lines:
    return as_rows(TUM, change)


def placed(change: Callable[[Array], Array]) -> Lines:
    return posed(lambda poses: se3(poses[:, :3, :3], change(poses[:, :3, 3])))


def replaced(marks: dict[str, str]) -> Lines:
    return lambda lines: [line.translate(str.maketrans(marks)) for line in lines]


def without_line(at: int) -> Lines:
    return lambda lines: lines[:at] + lines[at + 1 :]


def instead(at: int, values: str) -> Lines:
    return lambda lines: [*lines[:at], lines[at].split()[0] + values, *lines[at + 1 :]]


def headed(heading: str, of: Lines = lambda lines: lines[1:]) -> Lines:
    """Write a heading over the lines, in the place of another."""
    return lambda lines: [heading, *of(lines)]


SOUND: list[str] = []  # the lines before they were spoilt
CONJUGATED = posed(lambda poses: se3(np.swapaxes(poses[:, :3, :3], 1, 2), poses[:, :3, 3]))
INVERTED, BACKWARDS = posed(np.linalg.inv), posed(lambda poses: poses[::-1])
EXCHANGED = placed(lambda positions: positions[:, [1, 0, 2]])
STATE = "{t} {qw:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {x:.9f} {y:.9f} {z:.9f} 0 0 0 0 0 0 0 0 0"
# What spoils the lines of a sound file, then each advice with what somebody does who follows it.
ADVICE: list[tuple[Lines | str, ...]] = [
    (lambda lines: lines[:120] + lines[110:],
     "sort the file by time", lambda lines: sorted(lines, key=lambda line: float(line.split()[0])),
     "(and 9 more do); remove what is there twice", lambda lines: list(dict.fromkeys(lines))),
    (lambda lines: [*lines[:50], lines[49].split()[0] + " " + lines[50].partition(" ")[2], *lines[50:]],
     "keep one of the two", without_line(50)),
    (instead(50, " nan" * 7), "line 51 holds a value that is not finite; remove the line", without_line(50)),
    (lambda lines: [f"{i} {line}" for i, line in enumerate(lines)],
     "the first column is the number of the row, and stamps come first; remove it", ordered(" ", *range(1, 9))),
    (stamped(lambda t: t / 1000), "multiply the stamps by 1000", stamped(lambda t: t * 1000)),
    (stamped(lambda t: t + 7200),
     "the clocks are about -2 h apart, as time zones are: shift it", stamped(lambda t: t - 7200)),
    (stamped(lambda t: t - 1_700_000_000),
     "1700000000.000 s to it if both start together", stamped(lambda t: t + 1_700_000_000)),
    (stamped(lambda t: t * 1000), "milliseconds: divide by 1e3", stamped(lambda t: t / 1000)),
    (stamped(lambda t: f"{float(t):e}"), "write all digits of them, as %.9f does for seconds", lambda _: SOUND),
    (ordered(" ", 0, 1, 2, 3, 7, 4, 5, 6),
     "move the fifth column to the end", ordered(" ", 0, 1, 2, 3, 5, 6, 7, 4)),
    (as_rows(f"{{n}},{COMMAS},{QUATERNION}"),
     "EuRoC's order is qw,qx,qy,qz: move the eighth column before the fifth", ordered(",", 0, 1, 2, 3, 7, 4, 5, 6)),
    (as_rows(STATE),
     "OpenVINS' order is qx qy qz qw: move the scalar behind the others", ordered(" ", 0, 2, 3, 4, 1, *range(5, 17))),
    (headed("i,t,x,y,z,qx,qy,qz,qw", as_rows(f"{{i}},{{t}},{COMMAS},{W_FIRST}")),
     "exchange the names in the heading", headed("i,t,x,y,z,qw,qx,qy,qz")),
    (ordered(" ", 0, 4, 5, 6, 7, 1, 2, 3),
     "check the order of the columns", ordered(" ", 0, 5, 6, 7, 1, 2, 3, 4)),
    (CONJUGATED, "conjugate them", CONJUGATED),
    (INVERTED, "the poses look like those of the world in the IMU frame: invert each one", INVERTED),
    (BACKWARDS, "write them in the order of their stamps", BACKWARDS),
    (placed(lambda p: 1e3 * p), "divide its positions by 1000", placed(lambda p: 1e-3 * p)),
    (EXCHANGED, "write both in the same", EXCHANGED),
    (replaced({" ": ","}), "a TUM file has blanks between its columns", replaced({",": " "})),
    (replaced({".": ",", " ": ";"}), "with a point in numbers", replaced({",": ".", ";": " "})),
    (instead(9, " 1e12 0 0 0 0 0 1"), "check its unit, or remove the line", without_line(9)),
    (lambda lines: lines[:1], "write the whole trajectory", lambda _: SOUND),
    (headed("timestamp,latitude,longitude,altitude", as_rows(f"{{t}},{COMMAS}")),
     "convert them to metres (ENU, UTM)", headed("timestamp,x,y,z")),
    (lambda lines: [line.split()[0] + " nan nan nan 0 0 0 1" for line in lines],
     "no line holds a position that is finite; write it again", lambda _: SOUND),
]  # fmt: skip
# What is followed in a test of its own.
ELSEWHERE = {
    "multiply each pose by the inverse of the extrinsic (about {}) from the right": "of a body with other axes",
    "multiply each by the inverse of T_imu_cam from the right": "report/test_external_runs",
    "put {} with a stamp in seconds for each pose beside it, or give both without stamps": "poses of KITTI",
    "name it with --cov-convention": "test_covariances",
}


def without_stamps(lines: list[str], count: int | None = None) -> str:
    stamps_ns, positions, rotations = poses_of(lines[:count])
    return kitti.text(Trajectory(stamps_ns, se3(rotations, positions)))


def as_text(lines: list[str]) -> str:
    return "\n".join(lines) + "\n"


def files(estimate: Callable[[list[str]], str], truth: Callable[[list[str]], str] | None = None) -> Lines:
    """Write an estimate and, in the place of the one that is there, a truth."""

    def write(lines: list[str]) -> list[str]:
        Path("s.tum").write_text(estimate(lines))
        if truth is not None:
            Path("truth.tum").write_text(truth(lines))
        return lines

    return write


def late(by_s: str) -> Lines:
    return files(lambda lines: as_text(stamped(lambda t: t + Decimal(by_s))(lines)))


BY_LINE = files(without_stamps, without_stamps)
# What two files are and what is typed besides, the advice, and both as somebody has them who follows it.
TYPED = [
    (late("59.93"), "", "shift the one or the other with --offset", late("59.93"), "--offset -59.93"),
    (late("0.01"), "--max-dt 0.001", "or allow more with --max-dt", late("0.01"), "--max-dt 0.02"),
    (files(lambda lines: without_stamps(lines, 90), without_stamps), "",
     "write a pose for each, or a format with stamps", BY_LINE, ""),
    (files(lambda lines: without_stamps(lines, 9) + "nan " * 12, without_stamps), "",
     "holds a value that is not finite; write a pose for every frame", BY_LINE, ""),
    (files(as_text, lambda lines: as_text(lines[:1])), "",
     "a truth of 1 pose; give at least two", files(as_text, as_text), ""),
]  # fmt: skip


def test_every_advice_about_a_trajectory_is_followed_in_a_test() -> None:
    followed = [text for row in ADVICE for text in row if isinstance(text, str)] + [row[2] for row in TYPED]
    followed += ["leave out the convention of covariances", "choose a format with stamps"]  # below
    told = advice_in([*(TOOLKIT / "datasets/trajectories").glob("*.py"), TOOLKIT / "evaluation/scoring.py"])
    assert ELSEWHERE.keys() <= told
    assert not [advice for advice in told - ELSEWHERE.keys() if not is_followed(advice, followed)]


@pytest.mark.parametrize("row", TYPED, ids=[row[2] for row in TYPED])
def test_who_follows_an_advice_about_two_files_has_them_compared(scene, vislam, capsys, row) -> None:
    given, words, advice, followed, then = row
    t_ns = scene.stamps(5.0, 0.0, 40.0)
    lines = rows(t_ns, scene.poses_at(t_ns), TUM).splitlines()
    for write, typed, status in ((given, words, 3), (followed, then, 0)):
        write(lines)
        assert vislam("evaluate", "truth.tum", "s.tum", *typed.split(), "--quiet") == status
        assert (advice in capsys.readouterr().err) == (status == 3)


def test_who_follows_an_advice_about_a_format_writes_the_file(scene) -> None:
    poses = scene.poses_at(scene.stamps(5.0))
    poses[3] = np.nan
    given = Trajectory(scene.stamps(5.0), poses)
    with pytest.raises(DataError, match=r"pose 3 is not finite, .* rows are frames; choose a format with stamps"):
        kitti.text(given)
    for one in (tum, euroc, openvins):
        with pytest.raises(DataError, match="no covariances are known; leave out the convention of covariances"):
            one.text_with_covariances(given)
        assert one.text(given).count("\n") == len(poses)  # a heading, and all but the one


@pytest.mark.parametrize("row", ADVICE, ids=[str(row[1]) for row in ADVICE])
def test_who_follows_an_advice_has_a_file_that_is_read(scene, vislam, capsys, row) -> None:
    t_ns = scene.stamps(5.0, 0.0, 40.0)
    SOUND[:] = rows(t_ns, scene.poses_at(t_ns) @ se3_exp(noise(t_ns.size)), TUM).splitlines()
    spoil, *steps = row
    lines = spoil(SOUND)
    for advice, follow in zip(steps[::2], steps[1::2], strict=True):
        Path("s.tum").write_text(as_text(lines))
        assert vislam("evaluate", "truth.tum", "s.tum", "--quiet") == 3
        assert advice in capsys.readouterr().err
        lines = follow(lines)
    Path("s.tum").write_text(as_text(lines))
    assert scored(vislam)[0]["ate_se3_m"] < 0.2


def noise(count: int) -> Array:
    return np.random.default_rng(1).standard_normal((count, 6)) * np.repeat([0.001, 0.05], 3)


def test_a_run_that_ends_in_nan_is_one_that_failed_and_the_others_are_compared(scene, vislam, capsys) -> None:
    t_ns = scene.stamps(10.0)
    for run in range(6):
        for folder in ("base", "now"):
            scene.write(f"{folder}/truth/{run}.tum", t_ns, scene.estimated(t_ns, 0.1, run))
    assert vislam("baseline", "--trajectories", "base", "--truth", "truth=truth.tum", "--out", "b.json") == 0
    broken = Path("now/truth/3.tum")
    lines = broken.read_text().splitlines()
    broken.write_text("\n".join(line if i < 300 else line.split()[0] + " nan" * 7 for i, line in enumerate(lines)))
    capsys.readouterr()
    assert vislam("check", "--baseline", "b.json", "--trajectories", "now") == 1
    printed = capsys.readouterr().out
    assert "1 of 6 runs failed: now/truth/3.tum: 301 of 600 lines hold a value that is not finite" in printed
    assert "(29.9 s after the first to the end)" in printed
    assert "missing" not in printed
    assert "the gate fails: of 5 comparisons" in printed
