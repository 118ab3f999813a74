"""The formats of trajectory files as a table: which columns they have, in which order and units; and their checks.

TUM: Sturm, Engelhard, Endres, Burgard & Cremers, "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012).
KITTI: Geiger, Lenz & Urtasun, "Are we ready for autonomous driving?" (CVPR 2012); its own poses are the left camera's,
here, as in every file, they are the IMU's. EuRoC: Burri et al., "The EuRoC micro aerial vehicle datasets" (IJRR 2016).
OpenVINS: Geneva, Eckenhoff, Lee, Yang & Huang, "OpenVINS" (ICRA 2020): its states, and the recording of its poses with
two covariances, upper triangles row by row: of the orientation, whose error is a small turn of the IMU frame, and of
the position in the world. JPL's quaternion of the world to the IMU has the same four numbers as Hamilton's of the IMU
to the world. Behind the columns of TUM, EuRoC and OpenVINS' states a covariance may stand, as an upper triangle row by
row, of the pose or of the state; the header says which one it is (:mod:`~toolkit.datasets.trajectories.covariances`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, takewhile
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from toolkit.datasets.io.bag_reader import place_in_bag
from toolkit.datasets.io.fields import exact_ns, probable_unit, probable_unit_of_ns, stamps_ns
from toolkit.datasets.io.tables import Named, is_number, is_of_the_globe, named_columns
from toolkit.datasets.trajectories.covariances import (
    OPENVINS,
    OURS,
    STATE,
    CovConvention,
    StatedCovariances,
    from_triangle,
    said_in,
    written_as,
)
from toolkit.errors import DataError
from toolkit.estimate import FARTHEST_M, Trajectory
from toolkit.files.reading import read_text_input
from toolkit.geometry import (
    Array,
    BoolArray,
    IntArray,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3,
    transposed,
)
from toolkit.measurements import NS_PER_S

# Quaternions printed with four decimals are off by 1e-4; anything beyond 1e-2 is not a rounded rotation.
_UNIT_TOLERANCE = 1e-2
_TOO_FAR = f"has a position beyond {FARTHEST_M:g} m; check its unit, or remove the line"
# A file whose first four-vector is this close to (1, 0, 0, 0), as printed, starts at the identity if it is w first.
_IDENTITY_TOLERANCE = 1e-3
# Share of the rows that have the stamp of the one before, from which on stamps have too few digits.
_MOST_OF_ONE_STAMP = 0.2
INVERT_EACH = "the poses look like those of the world in the IMU frame: invert each one"
CONJUGATE = "the quaternions look like those of the world to the IMU, as JPL and Hamilton mixed up: conjugate them"
# Mean resultant length of the directions of travel in the body frame: 1 for a vehicle, about 0 for the wrong order.
# Of what it lacks in the world, a vehicle of 20 s lacks less than this share in its own frame, and not one in 10,000
# windows of 1 s and more in another reading; flights of 2 s reach 0.2 in the wrong order.
_VEHICLE_CONCENTRATION, _LEAST_GAIN, _UNEXPLAINED_BENDS = 0.97, 0.1, 0.1


# The lines of a file as cells ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rows:
    """What a table in a text file holds: the number and the cells of each line that is not empty or a comment.

    There is at least one line. ``commas``: they separate the cells, and not blanks. ``heading``: the names of the
    columns, of a line above the first row with as many words as that has cells. ``header``: all comments before it.
    """

    path: Path
    line_numbers: list[int]
    cells: list[list[str]]
    commas: bool
    heading: tuple[str, ...] = ()
    header: str = ""

    @property
    def width(self) -> int:
        return len(self.cells[0])

    def numbers(self, width: int, columns: str) -> Array:
        """Return all cells as numbers (N, width); raises DataError naming the line that has not these ``columns``."""
        # Python takes 1_0 for ten.
        if all(len(of_line) == width and "_" not in "".join(of_line) for of_line in self.cells):
            with suppress(ValueError):  # told below, with the line
                return np.fromiter(map(float, chain.from_iterable(self.cells)), dtype=float).reshape(-1, width)
        lines = zip(self.line_numbers, self.cells, strict=True)
        return np.array([self._numbers(n, cells, width, columns) for n, cells in lines], dtype=float)

    def stamps(self, per_unit_ns: int, at: int = 0) -> IntArray:
        """Return a column in units of ``per_unit_ns`` as :func:`exact_ns` does; raises DataError naming the line."""
        cells = [of_line[at] for of_line in self.cells]
        return exact_ns(cells, per_unit_ns, lambda row: f"{self.path}: line {self.line_numbers[row]}")

    def _numbers(self, line_number: int, cells: list[str], width: int, columns: str) -> list[float]:
        what = f"{self.path}: line {line_number}"
        if len(cells) != width:
            raise DataError(f"{what} has {len(cells)} columns, expected {width} ({columns})")
        for cell in cells:
            if not is_number(cell):
                point, shown = ", with a point in numbers" if any("," in cell for cell in cells) else "", cell[:50]
                raise DataError(
                    f"{what} is not numeric (could not convert string to float: {shown!r}); expected {columns}{point}"
                )
        return list(map(float, cells))


def read_rows(path: Path, kind: str) -> Rows:
    """Return the rows of a file; comments start with ``#``, and a heading without it may precede commas.

    ``kind`` describes such a file in an error. Raises DataError where it is missing, empty or not text.
    """
    text = read_text_input(path, kind)
    lines = text.splitlines()
    comments = [line.lstrip("#% ") for line in lines if line.startswith(("#", "%"))]
    if "#" in text:
        lines = [line.partition("#")[0] for line in lines]
    lines = ["" if line.startswith("%") else line for line in lines]
    last = next((line for line in reversed(lines) if line and not line.isspace()), "")
    separator = next((mark for mark in ";," if mark in last), None)
    cells = [_between(line, separator) for line in lines] if separator else [line.split() for line in lines]
    line_numbers = [n for n, of_line in enumerate(cells, start=1) if of_line]
    cells = [of_line for of_line in cells if of_line]
    headings = [_between(line, separator) if separator else line.split() for line in comments]
    if cells and not is_number(cells[0][0]) and (separator or named_columns(cells[0]) is not None):
        headings.append(cells[0])
        line_numbers, cells = line_numbers[1:], cells[1:]
    if not cells:
        raise DataError(f"{path}: the file holds no poses; {kind}")
    if any(is_of_the_globe(one) for one in headings):
        raise DataError(f"{path}: its positions are latitude and longitude; convert them to metres (ENU, UTM)")
    headings = [one for one in headings if len(one) == len(cells[0]) and named_columns(one) is not None]
    heading = tuple(headings[-1]) if headings else ()
    header = "\n".join(takewhile(lambda line: line.lstrip().startswith("#"), text.splitlines()))
    return Rows(path, line_numbers, cells, separator is not None, heading, header)


def stamp_text(t_ns: int) -> str:
    """Write nanoseconds as seconds with nine decimals; goes through integers, for a double holds only 16 digits."""
    sign, (seconds, rest_ns) = "-" if t_ns < 0 else "", divmod(abs(t_ns), NS_PER_S)
    return f"{sign}{seconds}.{rest_ns:09d}"


def _between(line: str, separator: str) -> list[str]:
    """Split a line, which has no cells where it is empty; some programs end theirs with a separator."""
    stripped = line.strip()
    return [cell.strip() for cell in stripped.removesuffix(separator).split(separator)] if stripped else []


# The formats ---------------------------------------------------------------------------------------------------------


class Reading(NamedTuple):
    """Another meaning that rotations (N, 3, 3) may have: ``only_if`` it holds they fit, and what to do about it.

    ``step`` is that through the positions (N, 3) then; it may be one of another body that is known, as the camera.
    """

    only_if: str
    remedy: str
    reread: Callable[[Array], Array]
    step: int = 1
    is_of_a_body: bool = False


def _w_first(remedy: str, roll: int = -1) -> Reading:
    """Return the reading in which the scalar, read as the last of a quaternion, comes first; or, rolled by 1, last."""
    return Reading(f"read w {'first' if roll < 0 else 'last'}", remedy, partial(_rolled, roll))


def _rolled(roll: int, rotations: Array) -> Array:
    return rotation_from_quaternion(np.roll(quaternion_from_rotation(rotations), roll, axis=-1))


@dataclass(frozen=True, eq=False)
class PosesFile:
    """The poses (N, 4, 4) of a trajectory file, their stamps (N,) ns, and how its quaternions might be misread.

    Stamps are None where the format has none, and the order where it has no quaternions. Velocities (N, 3), biases
    (N, 6) [accel, gyro] and ``covariances`` are there where the file has them. Orientations are all the identity where
    it has none. ``not_finite`` says which lines are left out, because they hold no finite pose.
    """

    path: Path
    format: str
    t_ns: IntArray | None
    T_world_imu: Array
    other_order: Reading | None
    covariances: StatedCovariances | None = None
    v_world: Array | None = None
    bias: Array | None = None
    not_finite: str = ""

    def __len__(self) -> int:
        return len(self.T_world_imu)

    def trajectory(self, t_ns: IntArray) -> Trajectory:
        """Return the states on some stamps (N,), with covariances where their convention is known."""
        cov = None if self.covariances is None else self.covariances.of(self.T_world_imu)
        return Trajectory(t_ns, self.T_world_imu, self.v_world, self.bias, cov)

    def with_convention(self, unless_said: CovConvention | None) -> "PosesFile":
        """Return the file with a convention for its covariances, where it has some and does not say it."""
        stated = self.covariances
        if stated is None or stated.convention is not None:
            return self
        return replace(self, covariances=replace(stated, convention=unless_said))

    def whole(self) -> "PosesFile":
        """Return the file; raises DataError where a line of it holds no finite pose."""
        if self.not_finite:
            raise DataError(f"{self.path}: {self.not_finite}")
        return self

    def check_order(self) -> None:
        """Raise DataError where the trajectory alone shows that its quaternions are in the other order, or inverted.

        A vehicle moves in one direction of its own frame, however its path bends. If that holds in another reading and
        not as given, the file is misread. Where no reading explains the bends (there are none, or the camera is
        hand-held), a start at the identity decides: read in the wrong order it is a start upside down.
        """
        other, positions, R_world_imu = self.other_order, self.T_world_imu[:, :3, 3], self.T_world_imu[:, :3, :3]
        if other is None:
            return
        R_imu_world, reread = transposed(R_world_imu), other.reread(R_world_imu)
        given = _travel(positions, R_world_imu)
        inverted = _travel(-np.einsum("nij,nj->ni", R_imu_world, positions), R_imu_world)
        otherwise = _travel(positions, reread)
        readings = {CONJUGATE: _travel(positions, R_imu_world), other.remedy: otherwise}
        # Far from its origin a path turns into a long swing about it, which bends by its own turns.
        if inverted.path_m <= given.path_m:
            readings = {INVERT_EACH: inverted, **readings}
        fitting = {remedy: one.ahead for remedy, one in readings.items() if one.explains_its_bends}
        better = {remedy: ahead for remedy, ahead in fitting.items() if ahead > given.ahead + _LEAST_GAIN}
        if better:
            # Where the vehicle turns about one axis only, the wrong order looks right as well: the likelier mistake is
            # named.
            likely = max(better, key=lambda remedy: better[remedy] - _LEAST_GAIN * (remedy == other.remedy))
            raise DataError(f"{self.path}: {likely}")
        starts_at_identity = np.linalg.norm(quaternion_from_rotation(reread[0])[:3]) < _IDENTITY_TOLERANCE
        if starts_at_identity and otherwise.ahead >= given.ahead - _LEAST_GAIN and not given.explains_its_bends:
            raise DataError(f"{self.path}: {other.remedy}")


# Behind the columns of a format: no covariance, those of orientation and position apart, that of the pose or the state.
Covariance = Literal["", "apart", "pose", "state"]
_TRIANGLES: Mapping[Covariance, int] = {"": 0, "apart": 12, "pose": 21, "state": STATE * (STATE + 1) // 2}


@dataclass(frozen=True)
class Stamped:
    """A format of stamps, positions (m) and quaternions; ``order`` are its columns behind the stamp.

    They count x y z qx qy qz qw vx vy vz, gyro bias and accelerometer bias (three each) from 0.
    """

    name: str
    columns: str
    header: str
    order: tuple[int, ...]
    other_order: Reading
    unit_ns: int = NS_PER_S
    commas: bool = False
    may_go_on: bool = False
    covariance: Covariance = ""

    @property
    def _width(self) -> int:
        return 1 + len(self.order) + _TRIANGLES[self.covariance]

    def recognises(self, rows: Rows) -> bool:
        fits = rows.width >= self._width if self.may_go_on else rows.width == self._width
        return fits and rows.commas == self.commas

    def parse(self, rows: Rows) -> PosesFile:
        """Return the poses of rows.

        Raises DataError, naming the line and the likely cause, where they are not a table of finite numbers, time does
        not increase or is in another unit, or quaternions are not of unit length.
        """
        if rows.commas != self.commas:
            separators = "commas, not blanks" if self.commas else "blanks, not commas"
            raise DataError(
                f"{rows.path}: in a {self.name} file the columns ({self.columns}) are separated by {separators}"
            )
        table = rows.numbers(max(rows.width, self._width) if self.may_go_on else self._width, self.columns)
        pose = [1 + self.order.index(column) for column in range(7)]
        # A view where nothing is moved: a copy lies in another order, in which sums may differ in the last bit.
        values = table[:, 1:8] if pose == [*range(1, 8)] else table[:, pose]
        file = _stamped_poses(rows, _stamps(rows, table, self.unit_ns), values, self.name)
        if len(file) < len(table):
            table = table[np.isfinite(values).all(axis=1)]
        v_world, bias = self._motion(table)
        stated = self._covariances(rows, table[:, 1 + len(self.order) : self._width])
        return replace(file, other_order=self.other_order, covariances=stated, v_world=v_world, bias=bias)

    def _motion(self, table: Array) -> tuple[Array | None, Array | None]:
        """Return velocities (N, 3) and biases (N, 6) [accel, gyro], None where the format or the file has none."""
        if len(self.order) <= 7:
            return None, None
        v_world, bias = table[:, 8:11], table[:, [14, 15, 16, 11, 12, 13]]
        return None if np.isnan(v_world).all() else v_world, None if np.isnan(bias).all() else bias

    def _covariances(self, rows: Rows, entries: Array) -> StatedCovariances | None:
        if not self.covariance:
            return None
        if self.covariance == "apart":
            # As OpenVINS records them: what couples orientation and position is not stated.
            values = np.full((len(entries), 6, 6), np.nan)
            values[:, :3, :3], values[:, 3:, 3:] = from_triangle(entries[:, :6]), from_triangle(entries[:, 6:])
            return StatedCovariances(values, OPENVINS)
        try:
            convention, lower = said_in(rows.header)
        except DataError as error:
            raise DataError(f"{rows.path}: its header: {error}") from error
        return StatedCovariances(from_triangle(entries, lower=lower), convention)

    def read(self, path: Path, kind: str | None = None) -> Trajectory:
        """Read a file; ``kind`` describes it in the error where that fails. Raises DataError as :meth:`parse` does."""
        poses = self.parse(read_rows(path, kind or f"a {self.name} file is text, one pose a line")).whole()
        assert poses.t_ns is not None
        return Trajectory(poses.t_ns, poses.T_world_imu)

    def text(self, trajectory: Trajectory) -> str:
        """Return a trajectory as the text of a file, without poses that are not finite; what it lacks is nan."""
        kept = _finite(trajectory)
        return self._text(kept, self.header, np.empty((len(kept), 0)))

    def text_with_covariances(self, trajectory: Trajectory, convention: CovConvention | None = None) -> str:
        """Return the same with the covariances of a trajectory, in a convention that the header then names.

        Without one it is the format's own: GTSAM's, or OpenVINS'. A state's covariance has nan where it is not known.
        Raises DataError where the trajectory has no covariances.
        """
        with_covariances = {"TUM": TUM_COV, "EuRoC": EUROC_COV, "OpenVINS": OPENVINS_COV}[self.name]
        kept = _finite(trajectory)
        if kept.cov is None:
            raise DataError("no covariances are known; leave out the convention of covariances")
        chosen = convention or (OPENVINS if self.name == "OpenVINS" else OURS)
        size = STATE if with_covariances.covariance == "state" else 6
        what = "order q p v bg ba; " if size == STATE else ""
        header = f"{self.header}\n# then the upper triangle of a covariance ({size} x {size}) row by row; {what}"
        rows, columns = np.triu_indices(size)
        values = written_as(chosen, kept.T_world_imu, kept.cov, size)[:, rows, columns]
        return self._text(kept, header + chosen.words, values)

    def _text(self, kept: Trajectory, header: str, more: Array) -> str:
        unknown = np.full((len(kept), 6), np.nan)
        v_world = unknown[:, :3] if kept.v_world is None else kept.v_world
        bias = unknown if kept.bias is None else kept.bias[:, [3, 4, 5, 0, 1, 2]]
        quaternions = quaternion_from_rotation(kept.T_world_imu[:, :3, :3])
        values = np.hstack([np.hstack([kept.positions, quaternions, v_world, bias])[:, self.order], more])
        stamps = map(stamp_text if self.unit_ns == NS_PER_S else str, kept.t_ns.tolist())
        return _rows_text(header, zip(stamps, values.tolist(), strict=True), "," if self.commas else " ")


class Kitti:
    """One pose a frame: the first three rows of its 4x4 matrix row by row between blanks, in metres; no stamps."""

    columns = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"
    _WIDTH = 12

    def recognises(self, rows: Rows) -> bool:
        return not rows.commas and rows.width == self._WIDTH

    def parse(self, rows: Rows) -> PosesFile:
        """Return the poses of rows, without stamps; raises DataError naming the line whose matrix is no rotation."""
        matrices = rows.numbers(self._WIDTH, self.columns).reshape(-1, 3, 4)
        rotations = matrices[:, :, :3]
        off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
        checks = (
            (np.isfinite(matrices).all(axis=(1, 2)), "holds a value that is not finite; write a pose for every frame"),
            (np.abs(matrices[:, :, 3]).max(axis=1, initial=0.0) < FARTHEST_M, _TOO_FAR),
            (off < _UNIT_TOLERANCE, f"does not hold a rotation; expected {self.columns}"),
            (np.linalg.det(rotations) > 0.0, "holds a reflection, not a rotation: the sign of an axis is wrong"),
        )
        _check_lines(rows.path, rows.line_numbers, checks)
        # Through quaternions, as in the other formats, so that printed digits leave a rotation.
        R_world_imu = rotation_from_quaternion(quaternion_from_rotation(rotations))
        return PosesFile(rows.path, "KITTI", None, se3(R_world_imu, matrices[:, :, 3]), None)

    def text(self, trajectory: Trajectory) -> str:
        """Return a trajectory, a pose for every frame, as text; raises DataError where a pose is not finite."""
        poses = trajectory.T_world_imu
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if bad.size:
            raise DataError(f"pose {bad[0]} is not finite, and KITTI's rows are frames; choose a format with stamps")
        return _rows_text("", (("", row) for row in poses[:, :3].reshape(-1, self._WIDTH).tolist()), " ")


_W_FIRST = "the quaternions look w first"
tum = Stamped(
    "TUM",
    "t x y z qx qy qz qw",
    "# t_s x_m y_m z_m qx qy qz qw: the IMU in the world; quaternions are Hamilton, scalar last",
    order=(0, 1, 2, 3, 4, 5, 6),
    other_order=_w_first(f"{_W_FIRST}; TUM order is qx qy qz qw: move the fifth column to the end"),
)
kitti = Kitti()
euroc = Stamped(
    "EuRoC",
    "t,x,y,z,qw,qx,qy,qz",
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
    order=(0, 1, 2, 6, 3, 4, 5),
    other_order=_w_first(
        "the quaternions look w last; EuRoC's order is qw,qx,qy,qz: move the eighth column before the fifth", roll=1
    ),
    unit_ns=1,
    commas=True,
    may_go_on=True,
)
openvins = Stamped(
    "OpenVINS",
    "t qx qy qz qw x y z vx vy vz bgx bgy bgz bax bay baz",
    "# timestamp(s) q_GtoI(x y z w, JPL) p_IinG v_IinG bg ba; nan is not known",
    order=(3, 4, 5, 6, 0, 1, 2, *range(7, 16)),
    other_order=_w_first(f"{_W_FIRST}; OpenVINS' order is qx qy qz qw: move the scalar behind the others"),
    may_go_on=True,
)
_OPENVINS_RECORDED = replace(tum, name="OpenVINS", columns=f"{tum.columns} Pr11 ... Pt33", covariance="apart")
TUM_COV, EUROC_COV = (
    replace(one, columns=f"{one.columns} and 21 of a covariance", may_go_on=False, covariance="pose")
    for one in (tum, euroc)
)
OPENVINS_COV = replace(
    openvins, columns=f"{openvins.columns} and 120 of a covariance", may_go_on=False, covariance="state"
)
# Of two that have the same width the header decides: more columns of EuRoC and OpenVINS may be anything.
_SAYS_SO: tuple[Stamped, ...] = (EUROC_COV, OPENVINS_COV)
POSITIONS_ALONE = "t x y z"
_MISNAMED = _w_first(f"{_W_FIRST}, and their heading says w last: exchange the names in the heading")
TrajectoryFormat = Stamped | Kitti
FORMATS: Mapping[str, TrajectoryFormat] = {"tum": tum, "kitti": kitti, "euroc": euroc, "openvins": openvins}
_KIND = (
    f"there are {', '.join(f'{name} ({one.columns})' for name, one in FORMATS.items())}, positions "
    f"({POSITIONS_ALONE}), and tables whose heading names their columns"
)


def read_poses(path: Path, cov_convention: CovConvention | None = None) -> PosesFile:
    """Read a file of any of the formats, which is recognised from its content, or poses of a bag (``run.bag:/odom``).

    ``cov_convention`` is that of its covariances where the file does not say it. Raises DataError, naming the line and
    the likely cause: a wrong unit of time is named, never repaired.
    """
    place = place_in_bag(path)
    if place is None:
        return read_finite_poses(path, cov_convention).whole()
    # Here, because what reads messages imports what makes tracks of images.
    from toolkit.datasets.bags import read_topic

    return read_topic(*place, cov_convention)


def read_finite_poses(path: Path, cov_convention: CovConvention | None = None) -> PosesFile:
    """Read a file as :func:`read_poses`, and leave lines out that hold no finite pose, as of a truth with gaps."""
    rows = read_rows(path, _KIND)
    said = cov_convention is not None or "cov-convention" in rows.header
    named = named_columns(rows.heading) if rows.heading else None
    with np.errstate(all="ignore"):  # the checks say what is wrong with values, and not NumPy
        if named is not None and not _is_usual(named, rows):
            return _by_name(rows, named)
        if rows.width == len(POSITIONS_ALONE.split()):
            return _by_name(rows, Named(0, None, (1, 2, 3), ()))
        if _begins_with_row_numbers(rows):
            raise DataError(f"{path}: the first column is the number of the row, and stamps come first; remove it")
        for one in (_OPENVINS_RECORDED, TUM_COV, *(_SAYS_SO if said else ()), *FORMATS.values()):
            if one.recognises(rows):
                return one.parse(rows).with_convention(cov_convention)
    kind = "separated by commas" if rows.commas else "separated by blanks"
    raise DataError(f"{path}: {rows.width} columns {kind} are no format that is known; {_KIND}")


def _is_usual(named: Named, rows: Rows) -> bool:
    """Say whether columns that have names are where a format has them that needs no names."""
    if named.nanoseconds is not None:
        return False
    begin = (named.stamp, *named.position)
    if begin == (0, 1, 2, 3) and rows.commas and named.quaternion == (5, 6, 7, 4):
        return named.unit_ns == 1 or (named.unit_ns is None and _unit_ns(rows.numbers(rows.width, "t")[:, 0]) == 1)
    if begin == (0, 1, 2, 3) and not rows.commas and named.quaternion == (4, 5, 6, 7):
        return any(one.recognises(rows) for one in (tum, TUM_COV, _OPENVINS_RECORDED))
    if named.quaternion or rows.width < 1 + len(tum.order):
        return False
    # Names that are not known may be those of a quaternion.
    unknown = rows.numbers(rows.width, ", ".join(rows.heading))[0, 4:8]
    return bool(np.abs(np.linalg.norm(unknown) - 1.0) < _UNIT_TOLERANCE)


def _by_name(rows: Rows, named: Named) -> PosesFile:
    table = rows.numbers(rows.width, ", ".join(rows.heading) or POSITIONS_ALONE)
    if named.nanoseconds is not None:
        t_ns = rows.stamps(NS_PER_S, named.stamp) + rows.stamps(1, named.nanoseconds)
    else:
        t_ns = _stamps(rows, table, named.unit_ns or _unit_ns(table[:, named.stamp]), named.stamp)
    turns = table[:, named.quaternion] if named.quaternion else np.tile([0.0, 0.0, 0.0, 1.0], (len(table), 1))
    kind = "columns by name" if named.quaternion else "positions alone"
    file = _stamped_poses(rows, t_ns, np.hstack([table[:, named.position], turns]), kind)
    return replace(file, other_order=_MISNAMED) if named.quaternion else file


def _stamps(rows: Rows, table: Array, unit_ns: int, at: int = 0) -> IntArray:
    """Return the stamps of rows (N,) ns; raises DataError naming a wrong unit, or stamps of too few digits."""
    _check_digits(rows, table, at)
    if unit_ns == NS_PER_S:
        stamps_ns(rows.path, "time", table[:, at])  # names a wrong unit
    t_ns = rows.stamps(unit_ns, at)
    unit = probable_unit_of_ns(table[:, at]) if unit_ns == 1 else None
    if unit is not None:
        is_tum = unit.startswith("seconds") and rows.commas and rows.width == 1 + len(tum.order)
        hint = "; a TUM file has blanks between its columns" if is_tum else ""
        raise DataError(f"{rows.path}: time must be in nanoseconds, but the stamps look like {unit}{hint}")
    return t_ns


def _unit_ns(stamps: Array) -> int:
    """Return the unit of stamps (N,) whose name says none: seconds, as TUM has them, or nanoseconds, as ROS does."""
    return 1 if (probable_unit(stamps) or "").startswith("nanoseconds") else NS_PER_S


def _begins_with_row_numbers(rows: Rows) -> bool:
    """Say whether the first column counts the rows, and the second increases as stamps do."""
    if rows.cells[0][0].partition(".")[0] not in ("0", "1"):
        return False
    try:
        first, second = np.array([[float(cell) for cell in cells[:2]] for cells in rows.cells]).T
    except ValueError:
        return False
    return bool(len(first) > 1 and first[0] in (0.0, 1.0) and (np.diff(first) == 1.0).all() and second.min() > 1e8)


def _stamped_poses(rows: Rows, t_ns: IntArray, values: Array, kind: str) -> PosesFile:
    kept = known_poses(values)
    numbers = [n for n, is_kept in zip(rows.line_numbers, kept.tolist(), strict=True) if is_kept]
    if not numbers:
        raise DataError(f"{rows.path}: no line holds a position that is finite; write it again")
    not_finite = "" if kept.all() else _lines_unknown(rows.line_numbers, t_ns, values)
    T_world_imu = checked_poses(rows.path, numbers, t_ns[kept], values[kept])
    return PosesFile(rows.path, kind, t_ns[kept], T_world_imu, None, not_finite=not_finite)


def _lines_unknown(numbers: list[int], t_ns: IntArray, values: Array) -> str:
    """Say which lines hold no pose that is known, and when that is."""
    bad = np.flatnonzero(~known_poses(values))
    what = "a quaternion of zeros" if np.isfinite(values[bad]).all() else "a value that is not finite"
    if bad.size == 1:
        return f"line {numbers[bad[0]]} holds {what}; remove the line"
    first_s, last_s = ((t_ns[row] - t_ns[0]) / NS_PER_S for row in (bad[0], bad[-1]))
    end = "the end" if bad[-1] == len(numbers) - 1 else f"{last_s:.1f} s"
    lines = f"{bad.size} of {len(numbers)} lines hold {what}, from line {numbers[bad[0]]} to {numbers[bad[-1]]}"
    return f"{lines} ({first_s:.1f} s after the first to {end})"


def known_poses(values: Array) -> BoolArray:
    """Say which rows (N, 7) hold a pose: a finite position, and a quaternion where any row states one."""
    stated = states_turns(values)
    known = np.isfinite(values[:, :3]).all(axis=1)
    return np.asarray(known & stated if stated.any() else known)


def states_turns(values: Array) -> BoolArray:
    """Say which rows (N, 7) state a quaternion, which is neither NaN nor zero."""
    return np.asarray(np.isfinite(values[:, 3:]).all(axis=1) & values[:, 3:].any(axis=1))


def checked_poses(path: Path, line_numbers: list[int], t_ns: IntArray, values: Array, row: str = "line") -> Array:
    """Return the poses (N, 4, 4) of rows (N, 7), x y z in metres and a Hamilton quaternion x y z w.

    Where no row states a quaternion, because all are zero or NaN, the orientations are the identity. Raises DataError,
    naming the ``row``, where a value is not finite, time does not increase or a quaternion is not of unit length.
    """
    if not states_turns(values).any():
        values = np.hstack([values[:, :3], np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))])
    checks = (
        (np.isfinite(values).all(axis=1), f"holds a value that is not finite; remove the {row}"),
        (np.abs(values[:, :3]).max(axis=1, initial=0.0) < FARTHEST_M, _TOO_FAR),
        *_increasing(t_ns, values),
        (
            np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) < _UNIT_TOLERANCE,
            "has a quaternion that is not of unit length; check the order of the columns",
        ),
    )
    _check_lines(path, line_numbers, checks, row)
    return se3(rotation_from_quaternion(values[:, 3:]), values[:, :3])


def _increasing(t_ns: IntArray, values: Array) -> Iterator[tuple[BoolArray, str]]:
    """Yield the checks of time: stamps that fall, poses that are there twice, and poses of one stamp."""
    step_ns = np.diff(t_ns, prepend=t_ns[:1] - 1)
    again = np.append(False, (values[1:] == values[:-1]).all(axis=1)) & (step_ns == 0)
    yield step_ns >= 0, "is earlier than the one before it; sort the file by time"
    repeated = f" (and {int(again.sum()) - 1} more do)" if again.sum() > 1 else ""
    yield ~again, f"repeats the one before it{repeated}; remove what is there twice"
    yield step_ns != 0, "has the stamp of the one before it, and another pose; keep one of the two"


def _check_digits(rows: Rows, table: Array, stamp: int = 0) -> None:
    """Raise DataError where many rows have the stamp of the one before and another pose: it has too few digits."""
    same = np.diff(table[:, stamp]) == 0.0
    if (same & (np.diff(table, axis=0) != 0.0).any(axis=1)).sum() > _MOST_OF_ONE_STAMP * len(table):
        few = (
            f"its {len(table)} lines have {np.unique(table[:, stamp]).size} different stamps, as {rows.cells[0][stamp]}"
        )
        raise DataError(f"{rows.path}: {few}; write all digits of them, as %.9f does for seconds")


def _check_lines(
    path: Path, numbers: list[int], checks: Iterable[tuple[BoolArray | np.bool, str]], row: str = "line"
) -> None:
    for passed, complaint in checks:
        if not passed.all():
            raise DataError(f"{path}: {row} {numbers[int(np.argmin(passed))]} {complaint}")


def _finite(trajectory: Trajectory) -> Trajectory:
    kept = np.isfinite(trajectory.T_world_imu).all(axis=(1, 2))
    others = (None if one is None else one[kept] for one in (trajectory.v_world, trajectory.bias, trajectory.cov))
    return Trajectory(trajectory.t_ns[kept], trajectory.T_world_imu[kept], *others)


def _rows_text(header: str, rows: Iterable[tuple[str, list[float]]], separator: str) -> str:
    """Return a file's text: the header, then each row's first entry and its values with 15 digits."""
    lines = (
        separator.join(([first] if first else []) + [f"{value:.15g}" for value in values]) for first, values in rows
    )
    return "\n".join([*([header] if header else []), *lines]) + "\n"


class _Travel(NamedTuple):
    """How long a path (m) is, and the mean resultant lengths, 0 to 1, of its steps in the body and in the world.

    A length is 1 where all steps point the same way, so that ``ahead`` is that of a vehicle, ``straight`` of a line.
    """

    path_m: float
    ahead: float
    straight: float

    @property
    def explains_its_bends(self) -> bool:
        """Say whether the steps have one direction in the body, and by far not in the world."""
        unexplained = _UNEXPLAINED_BENDS * (1.0 - self.straight)
        return self.ahead > _VEHICLE_CONCENTRATION and 1.0 - self.ahead < unexplained


def _travel(positions: Array, R_world_imu: Array) -> _Travel:
    """Return how positions (N, 3) move along the axes of bodies (N, 3, 3)."""
    steps = np.diff(positions, axis=0)
    path_m = float(np.linalg.norm(steps, axis=1).sum())
    in_body = np.einsum("nji,nj->ni", R_world_imu[:-1], steps)
    ahead, straight = (float(np.linalg.norm(x.sum(axis=0)) / (path_m or 1.0)) for x in (in_body, steps))
    return _Travel(path_m, ahead, straight)
