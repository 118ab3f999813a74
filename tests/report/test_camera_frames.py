"""Images in the report: frames that tracks were made of, and the error that an estimator's poses leave of each."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from toolkit.answers import Run
from toolkit.datasets import load_sequence
from toolkit.errors import DataError
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.configuration import Configuration
from toolkit.experiment.units import outcome_of
from toolkit.initialization import start_from_truth
from toolkit.report.html.payload import payload_of
from toolkit.report.records import read_report
from toolkit.report.report_json import CameraFrame
from toolkit.report.run_directory import MadeBy, RunFiles, read_run, write_run


@pytest.fixture(scope="module")
def filmed(kitti_drive: Path) -> Comparison:
    """The truth as an estimator, and one whose every other pose is 5 cm to the side."""
    sequence = load_sequence(str(kitti_drive))
    assert sequence.truth is not None
    right = Trajectory(sequence.frames_t_ns, sequence.truth.T_world_imu)
    shaken = right.T_world_imu.copy()
    shaken[::2, 1, 3] += 0.05
    runs = [
        Run(name, "ok", trajectory, trajectory, Landmarks.none(), None)
        for name, trajectory in (("right", right), ("shaken", Trajectory(right.t_ns, shaken)))
    ]
    failed = Run("failed", "failed", None, None, Landmarks.none(), None, log=("no start",))
    outcomes = tuple(outcome_of(run, sequence, 0) for run in (*runs, failed))
    return Comparison(str(kitti_drive), sequence, (), start_from_truth(sequence), (0,), outcomes)


@pytest.fixture(scope="module")
def directory(filmed: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("filmed") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda _figure, path, **_options: Path(path).touch())
        write_run(filmed, target, MadeBy("vislam compare drive", Configuration()))
    return target


def frames_of(directory: Path) -> tuple[CameraFrame, ...]:
    frames = read_report(directory / "report.json").frames
    assert isinstance(frames, tuple)
    return frames


def test_the_images_are_those_of_the_frames_with_all_their_sightings(directory: Path, filmed: Comparison) -> None:
    frames, sequence = frames_of(directory), filmed.sequence
    assert 2 <= len(frames) <= 4
    for frame in frames:
        k = int(np.argmin(np.abs(sequence.frames_s - frame.t_s)))
        here = sequence.observations.select(sequence.observations.frame == k)
        np.testing.assert_allclose(frame.u_px, here.uv_px[:, 0], rtol=1e-5)
        np.testing.assert_allclose(frame.v_px, here.uv_px[:, 2], rtol=1e-5)
        image = cv2.imread(str(directory / frame.image), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.shape == (frame.height_px, frame.width_px)


def test_a_worse_trajectory_leaves_larger_errors_and_a_failed_one_none(directory: Path) -> None:
    for frame in frames_of(directory):
        errors = {one.estimator: np.array(one.off_px, dtype=float) for one in frame.errors}
        assert errors.keys() == {"right", "shaken"}
        assert np.nanmedian(errors["right"]) < 0.5
        # 5 cm at 7 m and 230 px of focal length are more than a pixel
        assert np.nanmedian(errors["shaken"]) > 3.0 * np.nanmedian(errors["right"])


def test_the_page_holds_the_images_itself(directory: Path) -> None:
    files = read_run(directory)
    assert isinstance(files, RunFiles)
    case = payload_of([files])["cases"][0]
    rows = {row["estimator"]: row["id"] for row in case["rows"]}
    for frame in case["frames"]:
        assert frame["image"].startswith("data:image/jpeg;base64,/9j/")
        assert frame["off"].keys() == {rows["right"], rows["shaken"]}


def test_a_recording_without_images_has_no_frames(run_directory: Path) -> None:
    assert "frames" not in json.loads((run_directory / "report.json").read_text())
    assert not (run_directory / "frames").exists()
    files = read_run(run_directory)
    assert payload_of([files])["cases"][0]["frames"] == []


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/hostname"])
def test_a_report_that_names_files_elsewhere_is_refused(directory: Path, tmp_path: Path, name: str) -> None:
    changed = Path(shutil.copytree(directory, tmp_path / "run"))
    document = json.loads((changed / "report.json").read_text())
    document["frames"][0]["image"] = name
    (changed / "report.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="not in the run directory"):
        read_run(changed)
