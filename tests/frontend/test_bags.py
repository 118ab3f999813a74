"""Bags of ROS 1, ROS 2 and MCAP: the same recording as the folder they were written of, and what is told where not."""

import importlib.util
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import yaml

pytest.importorskip("rosbags", reason='bags are read and written with rosbags: pip install ".[bags]"')
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from toolkit.cli import main
from toolkit.datasets import load_images, load_sequence
from toolkit.datasets.io import bag_reader
from toolkit.errors import DataError
from toolkit.geometry import se3, so3_exp
from toolkit.measurements import ImuNoise
from toolkit.models.noise import mems_imu
from toolkit.motion_samples import ImuSamples, TwistSamples
from toolkit.settings import Frontend

TF = "tf2_msgs/msg/TFMessage"
KINDS = ("ros1", "sqlite", "mcap")


class Item(NamedTuple):
    """A message to be written."""

    t_ns: int
    topic: str
    type: str
    value: Any


def fill(message: Any, values: Mapping[str, Any]) -> Any:
    """Set fields of a message, and return it."""
    for name, value in values.items():
        part = getattr(message, name)
        if isinstance(value, Mapping):
            fill(part, value)
        elif is_dataclass(part):
            inner = [field.name for field in fields(part) if field.name != "__msgtype__"]
            number = int if "sec" in inner else float
            fill(part, dict(zip(inner, map(number, value), strict=True)))
        else:
            setattr(message, name, value)
    return message


@dataclass(frozen=True)
class Ros:
    """The messages of one generation of ROS."""

    kind: str
    store: Any

    @classmethod
    @cache
    def of(cls, kind: str) -> "Ros":
        store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if TF not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        return cls(kind, store)

    def zero(self, kind: str, **values: Any) -> Any:
        """Return a message of a type, zero but for some fields; a part of it is a mapping, or its numbers in order."""
        name = kind.replace("/", "/msg/") if kind.count("/") == 1 else kind
        fields = {field: self._nothing(*of_field) for field, of_field in self.store.fielddefs[name][1]}
        return fill(self.store.types[name](**fields), values)

    def _nothing(self, node: Any, detail: Any) -> Any:
        if node.name == "NAME":
            return self.zero(detail)
        if node.name == "BASE":
            return {"string": "", "bool": False}.get(detail[0], 0)
        (inner, of_inner), count = detail
        return np.zeros(count, of_inner[0]) if inner.name == "BASE" else []

    def item(self, t_ns: int, topic: str, kind: str, frame: str = "", **values: Any) -> Item:
        """Return a message with a header."""
        value = self.zero(kind, header={"stamp": divmod(int(t_ns), 10**9), "frame_id": frame}, **values)
        return Item(t_ns, topic, value.__msgtype__, value)

    def imu(self, t_ns: int, gyro: Any, accel: Any) -> Item:
        measured = {"angular_velocity": gyro, "linear_acceleration": accel}
        return self.item(t_ns, "/imu0", "sensor_msgs/Imu", "imu0", **measured)

    def image(self, t_ns: int, camera: str, image: np.ndarray, encoding: str = "mono8") -> Item:
        (height, width), data = image.shape[:2], np.ascontiguousarray(image).view(np.uint8).ravel()
        parts = {"height": height, "width": width, "encoding": encoding, "step": image.strides[0], "data": data}
        return self.item(t_ns, f"/{camera}/image_raw", "sensor_msgs/Image", camera, **parts)

    def compressed(self, t_ns: int, camera: str, content: bytes) -> Item:
        topic, data = f"/{camera}/image_raw/compressed", np.frombuffer(content, np.uint8)
        return self.item(t_ns, topic, "sensor_msgs/CompressedImage", camera, format="png", data=data)

    def camera_info(self, t_ns: int, camera: str, sensor: Mapping[str, Any]) -> Item:
        fx, fy, cx, cy = sensor["intrinsics"]
        lens = {"K": np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])}
        lens["D"] = np.array([*sensor["distortion_coefficients"], 0.0])
        lens = lens if self.kind == "ros1" else {name.lower(): values for name, values in lens.items()}
        lens |= dict(zip(("width", "height"), sensor["resolution"], strict=True))
        topic, model = f"/{camera}/camera_info", "plumb_bob"
        return self.item(t_ns, topic, "sensor_msgs/CameraInfo", camera, distortion_model=model, **lens)

    def transform(self, t_ns: int, topic: str, parent: str, child: str, T: np.ndarray) -> Item:
        moved = {"translation": T[:3, 3], "rotation": Rotation.from_matrix(T[:3, :3]).as_quat()}
        kind = "geometry_msgs/TransformStamped"
        return self.item(t_ns, topic, kind, parent, child_frame_id=child, transform=moved)

    def static(self, t_ns: int, T_imu_child: Mapping[str, np.ndarray], topic: str = "/tf_static") -> Item:
        moved = [self.transform(t_ns, topic, "imu0", child, T).value for child, T in T_imu_child.items()]
        return Item(t_ns, topic, TF, self.store.types[TF](moved))

    def pose_stamped(self, t_ns: int, values: Any) -> Item:
        pose = {"position": values[:3], "orientation": values[3:]}
        return self.item(t_ns, "/ground_truth/pose", "geometry_msgs/PoseStamped", "world", pose=pose)

    def odometry(self, t_ns: int, linear: Any, angular: Any) -> Item:
        twist, pose = {"twist": {"linear": linear, "angular": angular}}, {"pose": {"orientation": (0, 0, 0, 1)}}
        return self.item(t_ns, "/odom", "nav_msgs/Odometry", "odom", child_frame_id="imu0", twist=twist, pose=pose)

    def write(self, path: Path, items: list[Item]) -> Path:
        """Write messages to a bag in order of time and return its path."""
        storage = {"sqlite": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}.get(self.kind)
        writer = Writer1(path) if storage is None else Writer2(path, version=9, storage_plugin=storage)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        connections: dict[str, Any] = {}
        with writer:
            for item in sorted(items, key=lambda one: one.t_ns):
                if item.topic not in connections:
                    connections[item.topic] = writer.add_connection(item.topic, item.type, typestore=self.store)
                writer.write(connections[item.topic], item.t_ns, serialize(item.value, item.type))
        return path


def sensor(folder: Path) -> dict[str, Any]:
    """Return a sensor.yaml."""
    text = (folder / "sensor.yaml").read_text().removeprefix("%YAML:1.0\n")
    return dict(yaml.safe_load(text))


def motion_of(asl: Path, ros: Ros) -> Iterator[Item]:
    """Yield the IMU of an ASL folder."""
    for line in (asl / "mav0/imu0/data.csv").read_text().splitlines()[1:]:
        t, *values = line.split(",")
        yield ros.imu(int(t), values[:3], values[3:])


def images_of(asl: Path, make: Callable[[int, str, Path], Item]) -> Iterator[Item]:
    """Yield the images of an ASL folder."""
    for camera in ("cam0", "cam1"):
        for path in sorted((asl / "mav0" / camera / "data").iterdir()):
            yield make(int(path.stem), camera, path)


def truth_of(asl: Path, ros: Ros) -> Iterator[Item]:
    """Yield the truth of an ASL folder, from its TUM file."""
    for line in next(asl.glob("*.tum")).read_text().splitlines():
        if not line.startswith("#"):
            t, *values = line.split()
            yield ros.pose_stamped(int(Decimal(t) * 10**9), values)


def raw(ros: Ros) -> Callable[[int, str, Path], Item]:
    """Return a maker of raw grey images."""
    return lambda t_ns, camera, path: ros.image(t_ns, camera, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def calibration_of(asl: Path, ros: Ros, t_ns: int) -> Iterator[Item]:
    """Yield the calibration of an ASL folder as messages."""
    sensors = {camera: sensor(asl / "mav0" / camera) for camera in ("cam0", "cam1")}
    mounted = {camera: np.array(one["T_BS"]["data"]).reshape(4, 4) for camera, one in sensors.items()}
    yield ros.static(t_ns, mounted)
    for camera, one in sensors.items():
        yield ros.camera_info(t_ns, camera, one)


def written(asl: Path, kind: str, folder: Path, items: list[Item]) -> Path:
    """Write a bag into a folder, with the calibration files of an ASL folder beside it where there is one."""
    folder.mkdir(exist_ok=True)
    for name in ("cam0", "cam1", "imu0"):
        (folder / name).mkdir()
        shutil.copy(asl / "mav0" / name / "sensor.yaml", folder / name)
    return Ros.of(kind).write(folder / ("film.bag" if kind == "ros1" else "film"), items)


def film_of(asl: Path, ros: Ros) -> list[Item]:
    """Return the whole of an ASL folder as messages, and one that nobody needs."""
    film = [*motion_of(asl, ros), *images_of(asl, raw(ros)), *truth_of(asl, ros)]
    chatter = Item(film[0].t_ns, "/chatter", "std_msgs/msg/String", ros.zero("std_msgs/String", data="hello"))
    return [*film, chatter]


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_the_folder_it_was_written_of(asl: Path, tmp_path: Path, kind: str) -> None:
    bag = load_sequence(str(written(asl, kind, tmp_path / "bag", film_of(asl, Ros.of(kind)))))
    assert bag.content_hash() == load_sequence(str(asl)).content_hash()
    assert bag.name == "film"
    topics = "left /cam0/image_raw (guessed), right /cam1/image_raw (guessed), imu /imu0 (guessed)"
    assert f"topics: {topics}, truth /ground_truth/pose (guessed)" in bag.provenance.facts
    assert "topics not used: /chatter (std_msgs/String)" in bag.provenance.facts


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_that_brings_its_calibration_needs_no_file_beside_it(asl: Path, tmp_path: Path, kind: str) -> None:
    ros = Ros.of(kind)
    film = [*motion_of(asl, ros), *images_of(asl, lambda t, camera, path: ros.compressed(t, camera, path.read_bytes()))]
    path = ros.write(
        tmp_path / ("bare.bag" if kind == "ros1" else "bare"), [*film, *calibration_of(asl, ros, film[0].t_ns)]
    )
    bag, folder = load_sequence(str(path)), load_sequence(str(asl))
    # A quaternion keeps fifteen digits of a rotation, and sensor.yaml has twelve.
    np.testing.assert_allclose(bag.rig.T_imu_cam, folder.rig.T_imu_cam, atol=1e-9)
    assert bag.rig.baseline_m == pytest.approx(folder.rig.baseline_m, rel=1e-9)
    assert len(bag.observations) == len(folder.observations)
    np.testing.assert_allclose(bag.observations.uv_px, folder.observations.uv_px, atol=1e-3)
    assert bag.noise == mems_imu()
    assert any(fact.startswith("no noise of the IMU is stated") for fact in bag.provenance.facts)
    assert bag.truth is None
    keys = ("accelerometer_noise_density", "gyroscope_noise_density")
    keys += ("accelerometer_random_walk", "gyroscope_random_walk")
    (tmp_path / "imu.yaml").write_text("imu0:\n" + "".join(f"  {key}: 0.0{i + 1}\n" for i, key in enumerate(keys)))
    assert load_sequence(str(path)).noise == ImuNoise(0.01, 0.02, 0.03, 0.04)


def test_an_odometer_stands_for_the_motion_where_there_is_no_imu(asl: Path, tmp_path: Path) -> None:
    ros = Ros.of("mcap")
    poses = list(truth_of(asl, ros))
    twists = [ros.odometry(one.t_ns, [0.3, 0.1, 0.0], [0.0, 0.0, 0.2]) for one in poses]
    bag = load_sequence(str(written(asl, "mcap", tmp_path / "bag", [*images_of(asl, raw(ros)), *twists])))
    assert isinstance(bag.motion, TwistSamples)
    np.testing.assert_array_equal(bag.motion.values[0], [0.3, 0.1, 0.0, 0.0, 0.0, 0.2])
    assert "twist /odom (guessed)" in next(fact for fact in bag.provenance.facts if fact.startswith("topics: "))
    # Another system's estimate is no truth unless it is said to be.
    assert bag.truth is None


def test_poses_of_another_frame_are_moved_to_the_body(asl: Path, tmp_path: Path) -> None:
    ros = Ros.of("sqlite")
    T_imu_marker = se3(np.eye(3), np.array([0.1, 0.2, 0.3]))
    poses, marked = list(truth_of(asl, ros)), []
    for one in poses:
        at, turn = one.value.pose.position, one.value.pose.orientation
        T = se3(Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), np.array([at.x, at.y, at.z]))
        marked.append(ros.transform(one.t_ns, "/vicon/marker", "world", "marker", T @ T_imu_marker))
    static = ros.static(poses[0].t_ns, {"marker": T_imu_marker})
    film = [*motion_of(asl, ros), *images_of(asl, raw(ros)), *marked, static]
    truth = load_sequence(str(written(asl, "sqlite", tmp_path / "bag", film))).truth
    expected = load_sequence(str(asl)).truth
    np.testing.assert_allclose(truth.T_world_imu, expected.T_world_imu, atol=1e-9)


def test_a_truth_keeps_the_poses_it_has_or_is_of_positions_alone_or_left_out(asl: Path, tmp_path: Path) -> None:
    ros = Ros.of("sqlite")
    film = film_of(asl, ros)
    posed = [item for item in film if item.topic == "/ground_truth/pose"]
    posed[3].value.pose.position.x = np.nan
    lost = load_sequence(str(written(asl, "sqlite", tmp_path / "nan", film)))
    assert (
        f"1 of {len(posed)} poses of /ground_truth/pose are not finite and left out of the truth"
        in lost.provenance.facts
    )
    assert lost.truth is not None
    alone = "the truth is of positions alone"
    for item in posed:
        fill(item.value, {"pose": {"orientation": [0.0] * 4}})
    zero = load_sequence(str(written(asl, "sqlite", tmp_path / "zero", film)))
    assert any(alone in fact for fact in zero.provenance.facts)
    assert zero.truth is not None and (zero.truth.T_world_imu[:, :3, :3] == np.eye(3)).all()
    assert load_sequence(str(tmp_path / "zero/film"), 0, Frontend(topics="truth=none")).truth is None
    points = []
    for item in posed:
        at = item.value.pose.position
        where = {"x": at.x, "y": at.y, "z": at.z}
        points.append(ros.item(item.t_ns, "/leica/position", "geometry_msgs/PointStamped", point=where))
    film = [*(item for item in film if item not in posed), *points]
    path = written(asl, "sqlite", tmp_path / "point", film)
    assert load_sequence(str(path)).truth is None
    prism = load_sequence(str(path), 0, Frontend(topics="truth=/leica/position"))
    assert any(alone in fact for fact in prism.provenance.facts)


def bare(ros: Ros, asl: Path, infos: tuple[float, float] | None = None) -> list[Item]:
    """Return the messages of a bag that brings its calibration; ``infos`` are the Tx of P, of rectified images."""
    film = film_of(asl, ros)
    film += calibration_of(asl, ros, film[0].t_ns)
    if infos is None:
        return film
    moved = {"/cam0/camera_info": infos[0], "/cam1/camera_info": infos[1]}
    for item in film:
        if item.topic in moved:
            projection = item.value.P if hasattr(item.value, "P") else item.value.p
            projection[[0, 2, 5, 6, 10]] = [230.0, 160.0, 230.0, 120.0, 1.0]
            projection[3] = -230.0 * moved[item.topic]
    return [item._replace(topic=item.topic.replace("image_raw", "image_rect")) for item in film]


def test_a_gyro_and_an_accelerometer_apart_are_joined(asl: Path, tmp_path: Path) -> None:
    """As a RealSense camera publishes them: each leaves the other's values zero."""
    ros = Ros.of("ros1")
    apart = []
    for item in bare(ros, asl):
        if item.topic != "/imu0":
            apart.append(item)
            continue
        t_ns, gyro, accel = item.t_ns, vars(item.value.angular_velocity), vars(item.value.linear_acceleration)
        gyro, accel = ([value[axis] for axis in "xyz"] for value in (gyro, accel))
        apart.append(ros.imu(t_ns, gyro, [0.0] * 3)._replace(topic="/camera/gyro/sample"))
        # At the same rate between the gyro's stamps, rising in time.
        rising = [accel[0], accel[1], (t_ns - item.t_ns) + 1e-9 * (t_ns % 10**9)]
        apart.append(ros.imu(t_ns + 2_000_000, [0.0] * 3, rising)._replace(topic="/camera/accel/sample"))
    path = ros.write(tmp_path / "apart.bag", apart)
    motion = load_sequence(str(path)).motion
    assert isinstance(motion, ImuSamples)
    whole = load_sequence(str(asl)).motion
    np.testing.assert_array_equal(motion.gyro_radps, whole.gyro_radps[1:])
    np.testing.assert_allclose(motion.accel_mps2[:, 2], 1e-9 * (motion.t_ns % 10**9) - 0.002, atol=1e-9)


def test_the_baseline_is_between_both_projections_or_that_of_the_transforms(asl: Path, tmp_path: Path) -> None:
    """KITTI's colour cameras have a Tx each, that of the left one behind the origin."""
    ros = Ros.of("ros1")
    both, neither = ((-0.06, 0.06), (0.0, 0.0))
    film, turn = bare(ros, asl, both), so3_exp(np.array([0.01, -0.02, 0.03]))
    next(item.value for item in film if item.topic == "/cam0/camera_info").R[:] = turn.ravel()
    rig = load_images(str(ros.write(tmp_path / "both.bag", film))).rig
    assert rig.baseline_m == pytest.approx(0.12, rel=1e-12)
    # The frame of an image is its camera's own (REP 104), which R turns into the rectified one's.
    np.testing.assert_array_equal(rig.R_rect_cam, turn)
    path = ros.write(tmp_path / "neither.bag", bare(ros, asl, neither))
    expected = float(np.linalg.norm([0.12, 0.001, 0.0015]))
    assert load_images(str(path)).rig.baseline_m == pytest.approx(expected, rel=1e-9)


def test_transforms_of_tf_that_never_change_mount_the_camera(asl: Path, tmp_path: Path) -> None:
    ros = Ros.of("ros1")
    film = bare(ros, asl)
    static = next(item for item in film if item.topic == "/tf_static").value.transforms
    repeated = []
    for k, t_ns in enumerate(item.t_ns for item in film if item.topic == "/cam0/image_raw"):
        moving = ros.transform(t_ns, "/tf", "odom", "imu0", se3(np.eye(3), np.array([0.1 * k, 0.0, 0.0])))
        repeated.append(Item(t_ns, "/tf", TF, ros.zero(TF, transforms=[*static, moving.value])))
    film = [item for item in film if item.topic != "/tf_static"]
    path = ros.write(tmp_path / "tf.bag", [*film, *repeated])
    bag = load_sequence(str(path))
    np.testing.assert_allclose(bag.rig.T_imu_cam, load_sequence(str(asl)).rig.T_imu_cam, atol=1e-9)
    assert any("the transforms of /tf that never change" in fact for fact in bag.provenance.facts)


def test_images_that_are_rectified_already_are_found_by_their_rows(plain: Any, asl: Path, tmp_path: Path) -> None:
    """As kitti2bag writes them: lenses and turns of the raw cameras, and nothing in the name of the topic."""
    ros = Ros.of("ros1")
    stamps = [int(path.stem) for path in sorted((asl / "mav0/cam0/data").iterdir())]
    images = [
        ros.image(t_ns, camera, pair[side])
        for t_ns, pair in zip(stamps, plain.images, strict=True)
        for side, camera in enumerate(("cam0", "cam1"))
    ]
    infos = [item for item in bare(ros, asl, (0.0, 0.12)) if item.topic.endswith("camera_info")]
    for item in infos:
        turn = so3_exp(np.array([0.012, 0.003, -0.004]) * (1.0 if "cam1" in item.topic else -1.0))
        item.value.R[:] = turn.ravel()
    rest = [item for item in bare(ros, asl) if item.topic in ("/imu0", "/tf_static")]
    bag = load_sequence(str(ros.write(tmp_path / "kitti.bag", [*images, *infos, *rest])))
    assert (bag.rig.fx_px, bag.rig.baseline_m) == pytest.approx((230.0, 0.12))
    assert any(fact.startswith("the images are rectified already") for fact in bag.provenance.facts)


def test_a_folder_of_bags_without_metadata_is_its_only_bag_or_names_them(asl: Path, tmp_path: Path) -> None:
    ros = Ros.of("mcap")
    path = ros.write(tmp_path / "drive", bare(ros, asl))
    (path / "metadata.yaml").unlink()
    assert len(load_images(str(path)).pairs) == 10
    shutil.copy(path / "drive.mcap", path / "again.mcap")
    with pytest.raises(DataError, match=r"holds 2 bags and no metadata.yaml that joins them: again.mcap, drive.mcap"):
        load_images(str(path))
    (path / "notes.txt").write_text("a drive")
    with pytest.raises(DataError, match=r"is not a recording, but contains some: name again.mcap or drive.mcap in it"):
        load_images(str(path))


def split(asl: Path, folder: Path) -> Path:
    """Write a recording in two parts, as ROS 1 does, with the calibration beside them."""
    ros = Ros.of("ros1")
    film = sorted(film_of(asl, ros), key=lambda one: one.t_ns)
    written(asl, "ros1", folder, film[: len(film) // 2])
    (folder / "film.bag").rename(folder / "film_0.bag")
    ros.write(folder / "film_1.bag", film[len(film) // 2 :])
    return folder


def test_a_bag_that_was_split_is_read_whole_by_its_folder_and_in_part_by_a_name(asl: Path, tmp_path: Path) -> None:
    bag = load_sequence(str(split(asl, tmp_path / "bag")))
    assert bag.content_hash() == load_sequence(str(asl)).content_hash()
    alone = load_sequence(str(tmp_path / "bag/film_0.bag"))
    assert 0 < alone.frame_count < bag.frame_count


def test_without_the_library_a_bag_is_recognised_and_the_extra_named(
    asl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(asl, "ros1", tmp_path / "bag", film_of(asl, Ros.of("ros1")))
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(DataError, match=r"pip install \"vislam-toolkit\[bags\]\""):
        load_sequence(str(path))


def test_a_type_that_is_not_ros_own_is_not_read(asl: Path, tmp_path: Path) -> None:
    """Another definition under the name of an IMU, whose code is never made."""
    ros = Ros.of("ros1")
    path = written(asl, "ros1", tmp_path / "bag", film_of(asl, ros))
    content = path.read_bytes()
    digest = ros.store.generate_msgdef("sensor_msgs/msg/Imu")[1].encode()
    path.write_bytes(content.replace(digest, digest[::-1]))
    with pytest.raises(DataError, match="no sensor_msgs/Imu"):
        load_sequence(str(path))
    with bag_reader.opened(path) as bag:
        assert any("of another definition than ROS's" in str(topic) for topic in bag.topics)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_damaged_bag_is_read_or_refused_in_one_line(asl: Path, tmp_path: Path, kind: str) -> None:
    """Cut and flipped at twelve places each, spread over the file."""
    ros = Ros.of(kind)
    few = [item for item in film_of(asl, ros) if item.topic in ("/imu0", "/chatter")][:40]
    path = written(asl, kind, tmp_path / "bag", few)
    file = path if kind == "ros1" else next(path.glob("*.mcap"))
    content = file.read_bytes()
    for place in np.linspace(20, len(content) - 1, 12).astype(int).tolist():
        flipped = content[:place] + bytes([content[place] ^ 0x5A]) + content[place + 1 :]
        for damaged in (content[:place], flipped):
            file.write_bytes(damaged)
            with pytest.raises(DataError) as raised:
                load_sequence(str(file))
            assert "\n" not in str(raised.value)
            assert str(file) in str(raised.value)


def test_images_that_cannot_be_used_are_reported_with_their_topic(
    asl: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In every command: they are unpacked into a folder that nobody knows."""
    ros = Ros.of("ros1")
    film = [item for item in bare(ros, asl) if not item.topic.endswith("image_raw")]

    def cut(t_ns: int, camera: str, path: Path) -> Item:
        content = path.read_bytes()
        return ros.compressed(t_ns, camera, content[: len(content) // 2])

    path = ros.write(tmp_path / "film.bag", [*film, *images_of(asl, cut)])
    for words in (("check-data", str(path)), ("tracks", str(path), "--out", str(tmp_path / "stills"))):
        assert main(words) == 3
        printed = capsys.readouterr().err
        assert f"{path}: /cam0/image_raw/compressed: 10 of 10 image pairs cannot be used" in printed
        assert "damaged or truncated" in printed
        assert str(tmp_path) not in printed.replace(str(path), "")


def test_a_bag_that_breaks_off_leaves_nothing_behind(
    asl: Path, tmp_path: Path, own_cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The images before the damage are unpacked already, and the run's directory is not there yet."""
    ros = Ros.of("ros1")
    film = film_of(asl, ros)
    broken = ros.image(film[-2].t_ns, "cam1", np.zeros((4, 4), np.uint8), encoding="32FC1")
    path = written(asl, "ros1", tmp_path / "bag", [*film, broken])
    assert main(["compare", str(path), "--estimators", "dead-reckoning", "--out", str(tmp_path / "run")]) == 3
    messages = capsys.readouterr().err
    assert messages.count("\n") == 1
    assert "/cam1/image_raw: message" in messages
    assert not (tmp_path / "run").exists()
    assert list(own_cache.glob("images-*")) == []
