"""Settings arrive at the estimator they are for, and one that nobody reads is refused before anything runs."""

import re
from pathlib import Path

import pytest

from toolkit import runner
from toolkit.errors import EstimatorError
from toolkit.experiment.pipeline import Plan, prepared_cases, run
from toolkit.experiment.workers import Workers
from toolkit.settings.reading import settings_of

ESTIMATOR = '''"""Stands still, and says in its log what it was set to."""
from toolkit.estimate import Finished, Landmarks, Trajectory, Estimate

OPTIONS = ("gain", "mode")

def build(setup):
    return Still(setup)

class Still:
    def __init__(self, setup):
        self.setup, self.answers = setup, []

    def step(self, packet):
        self.answers.append(Estimate(packet.frame.t_ns, self.setup.prior.T_world_imu))
        return self.answers[-1]

    def finish(self):
        set_to = (f"{sorted(self.setup.options.items())}", f"lag {self.setup.settings.window.lag_s}")
        return Finished(Trajectory.of(self.answers), Landmarks.none(), log=set_to)
'''


@pytest.fixture
def written(tmp_path: Path) -> tuple[str, str]:
    """Return an estimator in a file of one's own that has options, and one that has none."""
    for name, text in (("tunable", ESTIMATOR), ("plain", ESTIMATOR.replace("OPTIONS", "OTHERS"))):
        (tmp_path / f"{name}.py").write_text(text)
    return str(tmp_path / "tunable.py"), str(tmp_path / "plain.py")


def plan(settings: dict[str, object], estimators: tuple[str, ...]) -> Plan:
    return Plan(("drive",), estimators, settings=settings_of(settings, "here"), max_frames=3, workers=1)


def test_an_estimator_is_given_its_options_and_the_common_settings(written):
    given = {"window": {"lag_s": 3.5}, "estimators": {"tunable": {"gain": 0.5, "mode": "fast"}, "plain": {}}}
    (comparison,) = run(plan(given, written))
    logs = {outcome.estimator: outcome.log[:2] for outcome in comparison.outcomes}
    assert logs == {"tunable": ("[('gain', 0.5), ('mode', 'fast')]", "lag 3.5"), "plain": ("[]", "lag 3.5")}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"tunable": {"gian": 1.0}}, "estimator tunable has no option gian; it has gain, mode"),
        ({"plain": {"landmark_uncertainty": 1.0}}, "estimator plain has no option landmark_uncertainty; it has none; "),
        ({"ekf": {"landmark_uncertainty": 3}}, "option landmark_uncertainty is 3; it takes true or false"),
    ],
)
def test_an_option_nobody_reads_is_refused_before_anything_runs(written, monkeypatch, options, expected):
    monkeypatch.setattr(runner, "run", None)
    with pytest.raises(EstimatorError, match=re.escape(expected)):
        prepared_cases(plan({"estimators": options}, (*written, "ekf")), Workers(1))
