"""What is compiled of the windowed filters computes what their NumPy does: NumPy is the definition."""

import importlib
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from filters.kalman import compiled as compiled_parts
from filters.kalman import track_gate, tracks_in_view
from filters.kalman.frame_gate import FrameGate
from filters.kalman.linearisation import AtFirstEstimates
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import WindowPoses
from filters.kalman.tracks_in_view import FollowedTracks, RootedWindow
from filters.kalman.triangulation import nearest_view
from toolkit.compilation import Compilation
from toolkit.models import stereo
from toolkit.models.gating import chi2_bound
from toolkit.simulation import FLIGHT

WINDOW, TRACKS = 9, 40
# Both round at 1e-16 of terms that cancel by up to a million, the carried covariance against the noise of a pixel.
TOLERANCE = 1e-9


@pytest.fixture(scope="module")
def kernels():
    pytest.importorskip("numba", reason="the extra 'fast' is not installed: there is nothing compiled to compare")
    requested = Compilation("compiled")
    return compiled_parts.track_test(requested), compiled_parts.steps_in_view(requested)


@pytest.fixture(scope="module")
def compiled(kernels):
    return kernels[0]


@pytest.fixture(scope="module")
def flight(window_of_clones):
    """A window of a flight, corrected once so that first and latest estimates differ."""
    sequence, joint = window_of_clones(replace(FLIGHT, duration_s=1.0), 2, WINDOW)
    clones = joint.clone_columns
    joint.update(np.eye(6, 6 * WINDOW, 6 * WINDOW - 6) * 40.0, np.full(6, 0.3), clones)
    return sequence.rig, WindowPoses(joint.clones, AtFirstEstimates().clones(joint), joint.cov[clones, clones])


def sightings_in(rig, window: WindowPoses) -> TrackSightings:
    """Return tracks of all lengths and with gaps; some mismatched, one behind the camera, one too far."""
    rng = np.random.default_rng(5)
    rays = np.stack([rng.uniform(-0.6, 0.6, TRACKS), rng.uniform(-0.4, 0.4, TRACKS), np.ones(TRACKS)], axis=1)
    in_imu = (rays * rng.uniform(3.0, 20.0, TRACKS)[:, None]) @ rig.T_imu_cam[:3, :3].T + rig.T_imu_cam[:3, 3]
    points = in_imu @ window.poses[-1, :3, :3].T + window.poses[-1, :3, 3]
    uvs_px = np.stack([stereo.predict(points, T, rig).uv_px for T in window.poses], axis=1)
    uvs_px += rng.normal(size=uvs_px.shape) @ np.linalg.cholesky(rig.cov_uv_px2).T
    uvs_px[:6, 4] += [25.0, 20.0, -30.0]
    uvs_px[6, :, 1] = uvs_px[6, :, 0] - 0.2
    uvs_px[7, :, :2] = uvs_px[7, :, 1::-1]
    seen = rng.random((TRACKS, WINDOW)) < rng.uniform(0.3, 1.0, TRACKS)[:, None]
    seen[:, 4:6] = True
    return TrackSightings(np.arange(TRACKS), uvs_px, seen)


def test_compiled_and_numpy_test_tracks_alike(compiled, flight):
    """Of rows in two bases of the same space those products are alike that any basis gives."""
    rig, window = flight
    arguments = sightings_in(rig, window), window, rig, chi2_bound(np.arange(3 * WINDOW + 1), 0.95)
    ours, theirs = track_gate.tested(*arguments), compiled(*arguments)
    assert ours.sightings.track_ids.tolist() == theirs.sightings.track_ids.tolist()
    assert ours.points == pytest.approx(theirs.points, rel=TOLERANCE)
    assert ours.nis == pytest.approx(theirs.nis, rel=TOLERANCE)
    longer = ours.sightings.seen.sum(axis=1) > 2  # of two sightings one is as bad as the other
    assert ours.worst[longer].tolist() == theirs.worst[longer].tolist()
    assert (ours.worst >= 0).tolist() == (theirs.worst >= 0).tolist()
    assert (ours.worst >= 0).any()
    assert len(ours.track) > 100
    assert set(ours.track) == set(theirs.track)
    for track in set(ours.track):
        a, b = ours.H[ours.track == track], theirs.H[theirs.track == track]
        r, s = ours.residuals[ours.track == track], theirs.residuals[theirs.track == track]
        assert a.T @ a == pytest.approx(b.T @ b, abs=TOLERANCE * np.abs(a.T @ a).max())
        assert a.T @ r == pytest.approx(b.T @ s, abs=TOLERANCE * np.abs(a.T @ a).max())


@pytest.mark.parametrize(("probability", "huber"), [(0.95, None), (0.999, 1.0), (None, None)])
def test_compiled_and_numpy_tell_the_same_of_tracks_in_view(kernels, flight, probability, huber):
    """Of tracks with rejected and weighed sightings, newest ones that do not fit and one that is behind a camera."""
    rig, window = flight
    tracks = followed_in(rig, window)
    ours, theirs = (
        tell(tracks, RootedWindow.of(window), rig, FrameGate(probability, huber))
        for tell in (tracks_in_view.information, kernels[1].information)
    )
    assert ours.usable.tolist() == theirs.usable.tolist()
    assert 0 < ours.usable.sum() < TRACKS
    some = ours.usable
    assert ours.points[some] == pytest.approx(theirs.points[some], rel=TOLERANCE)
    assert ours.weights[some] == pytest.approx(theirs.weights[some], rel=TOLERANCE)
    assert (ours.weights[some] == 0.0).any() == (probability is not None)
    assert ((ours.weights[some] > 0.0) & (ours.weights[some] < 1.0)).any() == (huber is not None)
    assert np.tril(ours.matrix) == pytest.approx(np.tril(theirs.matrix), abs=TOLERANCE * np.abs(ours.matrix).max())
    assert ours.vector == pytest.approx(theirs.vector, abs=TOLERANCE * np.abs(ours.matrix).max())


def followed_in(rig, window: WindowPoses) -> FollowedTracks:
    """Return the tracks that the newest pose sees, with landmarks a little off and some sightings that count less."""
    sightings = sightings_in(rig, window)
    sightings.seen[:, -1] = True
    sightings.uvs_px[10:14, -1] += [30.0, 28.0, 15.0]
    points = nearest_view(sightings.uvs_px, sightings.seen, window.poses, rig)[0]
    points[7] = window.poses[-1, :3, 3] - 5.0 * window.poses[-1, :3, :3] @ rig.T_imu_cam[:3, 2]
    rng = np.random.default_rng(6)
    weights = rng.choice([0.0, 0.4, 1.0], sightings.seen.shape, p=[0.1, 0.2, 0.7])
    weights[:, 4:] = 1.0
    weights[20:25, 4] = 0.6
    return FollowedTracks(sightings, np.arange(WINDOW), points + 0.1 * rng.normal(size=points.shape), weights)


def test_compiled_and_numpy_follow_the_same_landmarks(kernels, flight):
    """Of tracks known before, in another order and from other poses, and of new ones, seen once or too far away too."""
    rig, window = flight
    joint = SimpleNamespace(clones=window.poses, clone_frames=np.arange(3, 3 + WINDOW))
    known, sightings = followed_in(rig, window), sightings_in(rig, window)
    sightings.seen[35:37] = np.arange(WINDOW) == 4
    known = known._replace(clone_frames=np.arange(1, 1 + WINDOW)).select(np.arange(TRACKS) % 3 > 0)
    now = sightings.select(np.random.default_rng(8).permutation(TRACKS))
    ours, theirs = (follow(known, now, joint, rig) for follow in (tracks_in_view.followed, kernels[1].follow))
    assert 25 < len(ours.points) < TRACKS
    assert ours.sightings.track_ids.tolist() == theirs.sightings.track_ids.tolist()
    assert ours.points == pytest.approx(theirs.points, rel=TOLERANCE)
    assert (ours.weights < 1.0).any()
    np.testing.assert_array_equal(ours.weights, theirs.weights)


def test_nothing_is_learnt_from_no_track(kernels, flight):
    rig, window = flight
    none = followed_in(rig, window).select(np.zeros(TRACKS, dtype=bool))
    for tell in (tracks_in_view.information, kernels[1].information):
        nothing = tell(none, RootedWindow.of(window), rig, FrameGate(0.95))
        assert len(nothing.weights) == len(nothing.usable) == 0
        assert not nothing.matrix.any() and not nothing.vector.any()


def test_no_track_is_no_row(compiled, flight):
    rig, window = flight
    none = sightings_in(rig, window).select(np.zeros(TRACKS, dtype=bool))
    result = compiled(none, window, rig, chi2_bound(np.arange(3 * WINDOW + 1), 0.95))
    assert len(result.nis) == len(result.H) == len(result.residuals) == 0


def test_numpy_runs_where_nothing_is_set_and_where_it_is_requested():
    for compilation in (Compilation(), Compilation("numpy")):
        assert compiled_parts.track_test(compilation) is track_gate.tested
        assert compiled_parts.steps_in_view(compilation) is tracks_in_view.NUMPY
        assert compilation.ran == "numpy"


def test_importing_the_toolkit_and_its_estimators_imports_no_numba():
    code = (
        "import sys, toolkit, toolkit.cli\n"
        "from toolkit.estimator import discover\n"
        "[entry.load() for entry in discover().values()]\n"
        "print('numba' in sys.modules)"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == "False"


def test_what_was_kept_is_compiled_anew_when_any_source_of_its_folder_changes(kernels, tmp_path, monkeypatch):
    """numba itself looks at the function's own file alone."""
    from numba import types

    from filters.kalman.kernels.compiling import kept, what_was_compiled

    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "kept_one.py").write_text("def add(x):\n    return x + 1.0\n")
    other = tmp_path / "other.py"
    other.write_text("ONE = 1\n")

    def messages() -> str:
        sys.modules.pop("kept_one", None)
        return what_was_compiled(kept((types.float64,), tmp_path)(importlib.import_module("kept_one").add), "add was")

    assert messages() == "add was compiled, once for this version"
    assert messages() == ""
    other.write_text("ONE = 1.0\n")
    assert messages() != ""
    assert messages() == ""


@pytest.mark.parametrize("kind", [".nbi", ".nbc"])
@pytest.mark.parametrize("damaged", [lambda _: b"", lambda content: content[: len(content) // 2], lambda _: b"text"])
def test_what_was_kept_and_is_damaged_is_thrown_away_and_compiled_anew(kernels, tmp_path, monkeypatch, kind, damaged):
    from numba import types

    from filters.kalman.kernels.compiling import kept, what_was_compiled

    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "kept_two.py").write_text("def add(x):\n    return x + 1.0\n")

    def messages() -> str:
        sys.modules.pop("kept_two", None)
        kernel = kept((types.float64,), tmp_path)(importlib.import_module("kept_two").add)
        assert kernel(1.0) == 2.0
        return what_was_compiled(kernel, "add was")

    assert messages() != ""
    (file,) = tmp_path.rglob(f"*{kind}")
    file.write_bytes(damaged(file.read_bytes()))
    assert messages() == "add was compiled, once for this version"
    assert messages() == ""
