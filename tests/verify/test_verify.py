"""``vislam verify`` names what is wrong with a newcomer's estimator, and what is right about a sound one."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from toolkit import verify
from toolkit.cli import main
from toolkit.estimate import Estimate
from toolkit.verify import covariance_fault, difference, inconsistency

DECLINES = """        from toolkit.errors import EstimatorError
        if setup.motion_kind != "{}":
            raise EstimatorError("it needs measured velocities")
"""
NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
# An estimator of some thirty lines, as somebody writes who has read docs/extending.md and nothing else.
NEWCOMER = '''
"""Integrates what is measured and says how sure it is."""

import numpy as np

from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.models.motion import motion_model, predicted

SEEN = []


def build(setup):
    return Newcomer(setup)


class Newcomer:
    def __init__(self, setup):
        self.model = motion_model(setup.noise, setup.gravity_world)
        self.belief = self.model.initial_belief(setup.prior)
        self.answers = []
        self.pose = np.eye(4)

    def step(self, packet):
        self.belief = predicted(self.belief, self.model, packet.motion)
        k = packet.index
        T, cov = self.belief.T_world_imu.copy(), self.belief.cov.copy()
        # PLANT
        self.answers.append(Estimate(packet.frame.t_ns, T, cov))
        return self.answers[-1]

    def finish(self):
        return Finished(Trajectory.of(self.answers), Landmarks.none())
'''
FINITE, ROTATIONS, STAMPS, CAUSAL, SAME, LATER, UNTOUCHED = verify.OF_A_RUN
COVARIANCES, HONEST, RUNS = verify._COVARIANCE, verify._NEES, "it runs to the end"
# Lines planted: the promise that each breaks, and what is told of that.
PLANTS = (
    # Look-ahead through the base of an array, and through what another run left.
    ("T[:3, 3] += 1e-6 * len(getattr(packet.frame.uvs_px, 'base', ()))", CAUSAL, "where the packets from frame 2"),
    ("SEEN.append(packet.frame.t_ns); T[0, 3] += 1e-6 * (max(SEEN) - packet.frame.t_ns)", CAUSAL, "where the packets"),
    ("cov[0, 1] = cov[1, 0] = 2.0 * np.sqrt(cov[0, 0] * cov[1, 1])", COVARIANCES, "frame 0 is not positive definite"),
    ("cov[0, 3] += 1e-9", COVARIANCES, "frame 0 is not symmetric"),
    ("cov[4] = cov[:, 4] = 0.0", COVARIANCES, "has the variance 0 in row 4"),
    ("T[1, 3] = np.nan if k == 12 else T[1, 3]", FINITE, "T_world_imu of its answer to frame 12"),
    ("cov[2, 2] = np.nan if k == 12 else 1.0", COVARIANCES, "frame 12 is not finite"),
    ("T[0, 3] += 1e-9 * np.random.default_rng().standard_normal()", SAME, "differs at frame 0: T_world_imu differs by"),
    ("self.pose[:] = T; T = self.pose", LATER, "its answer to frame 0 changed after it was given"),
    ("T[:3, :3] *= 1.001", ROTATIONS, "rotations are none"),
    ("return None if k % 5 == 4 else Estimate(packet.frame.t_ns, T)", STAMPS, "answers at"),
    ("1 / (k - 9)", RUNS, "drive: ZeroDivisionError in line 27 of step: division by zero"),
    ("T = T[:3]", RUNS, "T_world_imu of its answer to frame 0 has shape (3, 4); expected (4, 4)"),
    # At the first motion, where alone an EstimatorError declines the input.
    ("1 / (k - 1)", RUNS, "drive: ZeroDivisionError in line 27 of step: division by zero"),
)


@pytest.fixture
def newcomer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Return a function that writes the estimator with a line planted."""
    monkeypatch.chdir(tmp_path)

    def write(plant: str) -> Path:
        Path("my_filter.py").write_text(NEWCOMER.replace("# PLANT", plant))
        return Path("my_filter.py")

    return write


@pytest.fixture
def only_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes seconds: seeds, threads and faults."""
    passed = verify.CheckRecord(name="left out", result="passed", found="", remedy="")
    for name in ("_consistent", "_threads"):
        monkeypatch.setattr(verify, name, lambda *_: passed)
    monkeypatch.setattr(verify, "PLANTED_FAULTS", {})


def checks(capsys) -> dict[str, dict[str, str]]:
    return {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}


def failed(capsys) -> dict[str, dict[str, str]]:
    return {name: check for name, check in checks(capsys).items() if check["result"] == "failed"}


def planted(monkeypatch, *some: str) -> None:
    """Leave out all planted faults but some."""
    monkeypatch.setattr(verify, "PLANTED_FAULTS", {name: verify.PLANTED_FAULTS[name] for name in some})


@pytest.mark.usefixtures("only_runs")
@pytest.mark.parametrize(("plant", "promise", "messages"), PLANTS)
def test_what_is_planted_is_named_with_what_to_do(newcomer, capsys, plant, promise, messages):
    assert main(["verify", str(newcomer(plant)), "--json"]) == 1
    found = failed(capsys)
    assert messages in found[promise]["found"]
    assert found[promise]["remedy"]
    if promise in (COVARIANCES, ROTATIONS):
        assert list(found) == [promise]


@pytest.mark.usefixtures("only_runs")
def test_one_without_a_covariance_is_fine(newcomer, capsys):
    assert main(["verify", str(newcomer("cov = None")), "--json"]) == 0
    found = checks(capsys)[COVARIANCES]
    assert (found["result"], found["found"]) == ("not applicable", "it states no covariance")


@pytest.mark.usefixtures("only_runs")
def test_it_may_be_a_module_of_another_package(newcomer, capsys, monkeypatch):
    newcomer("cov[0, 3] += 1e-9")
    Path("others").mkdir()
    Path("others/__init__.py").touch()
    Path("my_filter.py").rename("others/other_filter.py")
    monkeypatch.syspath_prepend(".")
    assert main(["verify", "others.other_filter", "--json"]) == 1
    assert list(failed(capsys)) == [COVARIANCES]


def test_who_dies_of_a_fault_is_reported_with_that_fault(newcomer, monkeypatch):
    planted(monkeypatch, "2 s without sightings", "a camera 20 ms late")
    path = newcomer("assert len(packet.frame.track_ids), 'no sightings'")
    found = verify.ends_by_fault("my-filter", verify.subject_of(str(path)).load())
    assert set(found) == {"2 s without sightings (drive)", "2 s without sightings (flight)"}
    assert "AssertionError: no sightings" in found["2 s without sightings (drive)"]
    (told,) = verify._causes(found)
    assert told.startswith("2 s without sightings (drive) and 1 more: ")


def test_an_input_that_an_estimator_is_not_made_for_breaks_no_promise(newcomer, capsys, monkeypatch):
    """It says in ``build`` that it needs velocities; one that takes no input at all does not run."""
    planted(monkeypatch, "2 s without sightings")
    monkeypatch.setattr(verify, "_NEES_DURATION_S", 3.0)
    path = newcomer("assert packet.motion is None or packet.motion.v_mps is not None")
    text = path.read_text()
    for kind, status in (("twist", 0), ("none", 1)):
        path.write_text(text.replace("        self.model =", DECLINES.format(kind) + "        self.model ="))
        assert main(["verify", str(path), "--json"]) == status
        found = checks(capsys)[RUNS]
        assert "it needs measured velocities" in found["found"]
        assert (found["result"] == "passed") == found["found"].startswith("not applicable to drive-imu, flight: ")


def test_a_process_that_cannot_start_breaks_no_promise(monkeypatch):
    def refused(*_given, **_named):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("toolkit.verify.ProcessPoolExecutor.submit", refused)
    checked = verify._threads("ekf")
    assert checked.result == "not applicable"
    assert "not checked" in checked.found


def test_a_process_that_the_estimator_ends_breaks_the_promise(newcomer):
    path = newcomer("import os; k == 3 and os._exit(9)")
    assert verify._threads(str(path)).result == "failed"


def test_the_filter_of_the_notebook_keeps_every_promise(tmp_path, monkeypatch, capsys):
    source = (NOTEBOOKS / "04_your_own_estimator.py").read_text()
    (imports,) = re.findall(r"IMPORTS = '''(.*?)'''", source, re.DOTALL)
    cell = next(part for part in source.split("# %%\n") if part.startswith("class TwoView")).partition("# %% [")[0]
    monkeypatch.chdir(tmp_path)
    Path("two_view.py").write_text(imports + cell)
    assert main(["verify", "two_view.py"]) == 0
    messages = capsys.readouterr().out
    assert "two-view keeps every promise" in messages
    assert messages.count("  passed") == 12


@pytest.mark.parametrize(("row", "column", "value", "fault"), [
    (0, 0, 1e-12, ""),
    (0, 3, 0.9e-9 * 1e-3, ""),  # of the geometric mean of their variances
    (0, 3, 1.1e-9 * 1e-3, "not symmetric"),
    ((0, 3), (3, 0), 1.1e-3, "not positive definite"),
])  # fmt: skip
def test_a_covariance_with_units_far_apart_may_round_and_no_more(row, column, value, fault):
    cov = np.diag([1e-12, 1e-12, 1e-12, 1e6, 1e6, 1e6])
    cov[row, column] = value
    assert fault in (found := covariance_fault(cov))
    assert bool(found) == bool(fault)


def test_too_sure_and_too_timid_are_distinguished_from_honest():
    rng = np.random.default_rng(0)
    # Poses of a run share one error in the worst case: a chi-square of 6 over 6 each, over eight runs.
    alarms = sum(bool(inconsistency((rng.chisquare(6, 8) / 6.0).tolist())) for _ in range(2000))
    assert alarms <= 8  # of 2000 at 0.1 % two are expected; a Poisson of 2 exceeds 8 once in four thousand
    assert "overconfident" in inconsistency([2.5] * 8)
    assert "less certain" in inconsistency([0.3] * 8)


@pytest.mark.parametrize(
    ("word", "text", "expected"),
    [
        ("nowhere.py", None, "nowhere.py: there is no such file"),
        ("mine.py", "def build(setup)\n", "mine.py, line 1: it cannot be imported (SyntaxError"),
        ("mine.py", "import nothing_of_the_kind\n", "No module named 'nothing_of_the_kind'"),
        ("mine.py", "x = 1\n", "mine.py defines no function build(setup)"),
        ("mine.py", "import sys\nsys.exit(3)\n", "mine.py: it cannot be imported (SystemExit: 3)"),
        ("mine.py", "\0", "mine.py: it cannot be imported (SyntaxError"),
        ("ekff", None, "no estimator is called ekff (did you mean ekf?)"),
        (".", None, "no estimator is called ."),
        ("no_such.filter", None, "no_such.filter: it cannot be imported (ModuleNotFoundError"),
    ],
)
def test_what_cannot_be_loaded_is_reported_in_one_line(tmp_path, monkeypatch, capsys, word, text, expected):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        Path(word).write_text(text)
    assert main(["verify", word]) == 5
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert expected in printed


def test_an_answer_of_another_kind_is_named():
    one = Estimate(0, np.eye(4), info={"nis": 1.0})
    assert difference(one, Estimate(0, np.eye(4), info={"nis": 1.0})) == ""
    assert difference(one, Estimate(0, np.eye(4), info={"nis": 2.0})) == "its diagnostics (info) differ"
    assert difference(one, None) == "one run returns an estimate and the other does not"
    assert difference(one, Estimate(0, np.eye(4), np.eye(6))) == "other fields or shapes"
