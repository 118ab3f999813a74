"""One table of files that are wrong in one thing each: each is refused in one line that names the file and words."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.conftest import assert_refused
from toolkit.datasets.io.fields import read_fields
from toolkit.datasets.io.truth import load_truth
from toolkit.datasets.trajectories import FORMATS, read_poses
from toolkit.estimate import Trajectory
from toolkit.geometry import se3, so3_exp


def test_a_rig_of_many_cameras_may_share_what_they_have(tmp_path: Path) -> None:
    shared = "".join(f"cam{i}:\n  T: *T\n  resolution: *size\n" for i in range(1, 9))
    (tmp_path / "rig.yaml").write_text(f"cam0:\n  T: &T [[1, 0], [0, 1]]\n  resolution: &size [3, 2]\n{shared}")
    np.testing.assert_array_equal(read_fields(tmp_path / "rig.yaml").arrays["cam8.T"], np.eye(2))


X = {"tum": 1, "kitti": 3, "euroc": 1, "openvins": 5}
# Row and column of a word, what stands there, and what the answer says; TIME and QUATERNION are of files with stamps.
CELLS = [
    (3, X, "nan", "line 4 holds a value that is not finite"),
    (3, X, "x1", "line 4 is not numeric"),
    (3, X, "1_0", "line 4 .*could not convert string to float: '1_0'"),
    (3, X, "1e10", r"line 4 has a position beyond 1e\+09 m; check its unit"),
    (3, X, "9" * 400, "line 4.*(not finite|beyond)"),
]
TIME = dict.fromkeys(("tum", "euroc", "openvins"), 0)
QUATERNION = {"tum": 4, "euroc": 4, "openvins": 1}
OF_STAMPS = [
    (2, TIME, "the same", "line 3 has the stamp of the one before it; keep one of the two"),
    (2, QUATERNION, "3.0", "line 3 has a quaternion that is not of unit length"),
]


@pytest.mark.parametrize(
    ("name", "row", "column", "word", "says"),
    [(name, row, where[name], word, says) for row, where, word, says in CELLS + OF_STAMPS for name in where],
)
def test_a_cell_of_a_trajectory(tmp_path: Path, name: str, row: int, column: int, word: str, says: str) -> None:
    rng = np.random.default_rng(5)
    poses = se3(so3_exp(rng.normal(size=(6, 3))), rng.normal(size=(6, 3)))
    separator = "," if name == "euroc" else " "
    text = FORMATS[name].text(Trajectory(1_600_000_000_123_456_789 + 10**8 * np.arange(6), poses))
    rows = [line.split(separator) for line in text.splitlines() if not line.startswith("#")]
    path = tmp_path / "poses"

    def write() -> None:
        path.write_text("\n".join(separator.join(cells) for cells in rows))

    width = len(rows[0])
    rows[row][column] = rows[row - 1][column] if word == "the same" else word
    write()
    assert_refused(lambda: read_poses(path), path, says)
    del rows[row][4:]
    write()
    columns = re.escape(f"has 4 columns, expected {width} ({FORMATS[name].columns})")
    assert_refused(lambda: read_poses(path), path, f"line {row + 1} {columns}")


TEXTS = [
    (b"", r"the file holds no poses; there are tum \(t x y z qx qy qz qw\), kitti"),
    (b"timestamp,x,y,z,qw,qx,qy,qz\n", "the file holds no poses"),
    (b"\xff\xfe\x00\x80", "not a text file"),
    (b"1 2 3 4 5\n", "5 columns separated by blanks are no format that is known; there are tum"),
    (b"1,2,3,4,5\n", "5 columns separated by commas are no format that is known"),
    (b"1e400 0 0 0 0 0 0 1\n", r"time\[0\] is inf"),
    (b"1e12 0 0 0 0 0 0 1\n", "must be in seconds"),
    (b"nan,0,0,0,1,0,0,0\n", r"line 1 has no finite time \(nan\); remove the line"),
    (b"1e30,0,0,0,1,0,0,0\n", "line 1 has the time 1e30, beyond any clock"),
    (b"1 0 0 5 0 1 0 6 0 0 1 7\n-1 0 0 5 0 1 0 6 0 0 1 7", "line 2 holds a reflection, not a rotation"),
    (b"1 0 0 5 0 1 0 6 0 0 1 7\n1.1 0 0 5 0 1 0 6 0 0 1 7", "line 2 does not hold a rotation; expected r11 r12"),
]


@pytest.mark.parametrize(("content", "says"), TEXTS)
def test_a_file_that_is_no_trajectory(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "poses"
    path.write_bytes(content)
    assert_refused(lambda: read_poses(path), path, says)
    path.write_bytes(b"1.0,0,0,0,0,0,0,1\n")
    assert_refused(lambda: load_truth(path), path, "separated by blanks, not commas")
    for absent in (tmp_path / "absent", tmp_path):
        assert_refused(lambda: read_poses(absent), absent, "cannot be read")  # noqa: B023 - called at once
