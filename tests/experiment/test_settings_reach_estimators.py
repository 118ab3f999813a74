"""Settings arrive at the estimator they are for, and one that nobody reads is refused before anything runs."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from toolkit import discovery, runner
from toolkit.errors import EstimatorError
from toolkit.experiment.pipeline import Plan, prepared_cases, run
from toolkit.experiment.workers import Workers
from toolkit.registry import ENTRY_POINT_GROUP, find
from toolkit.settings.reading import settings_of

_ESTIMATOR = '''
"""Stands still, and says in its log what it was set to."""
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
def tunable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the name of an installed estimator with options of its own."""
    from importlib.metadata import EntryPoint

    package = tmp_path / "estimators_with_options"
    package.mkdir()
    (package / "__init__.py").write_text('"""Somebody\'s."""\n')
    (package / "tunable.py").write_text(_ESTIMATOR.lstrip())
    (package / "plain.py").write_text(_ESTIMATOR.lstrip().replace("OPTIONS", "OTHERS"))
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint(package.name, package.name, ENTRY_POINT_GROUP)
    monkeypatch.setattr(discovery, "entry_points", lambda group: [point] if group == ENTRY_POINT_GROUP else [])
    yield "tunable"
    import sys

    for module in [m for m in sys.modules if m.partition(".")[0] == package.name]:
        del sys.modules[module]


def plan(settings: dict[str, object], *estimators: str) -> Plan:
    return Plan(("drive",), estimators, settings=settings_of(settings, "here"), max_frames=3, workers=1)


def test_an_estimator_is_given_its_options_and_the_common_settings(tunable):
    given = {"window": {"lag_s": 3.5}, "estimators": {tunable: {"gain": 0.5, "mode": "fast"}, "plain": {}}}
    (comparison,) = run(plan(given, tunable, "plain"))
    logs = {outcome.estimator: outcome.log[:2] for outcome in comparison.outcomes}
    assert logs[tunable] == ("[('gain', 0.5), ('mode', 'fast')]", "lag 3.5")
    assert logs["plain"] == ("[]", "lag 3.5")
    assert comparison.settings.options_of(tunable) == {"gain": 0.5, "mode": "fast"}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"tunable": {"gian": 1.0}}, "estimator tunable has no option gian; it has gain, mode"),
        ({"plain": {"gain": 1.0}}, "estimator plain has no option gain; it has none; tunable has it"),
    ],
)
def test_an_option_nobody_reads_is_refused_before_anything_runs(tunable, monkeypatch, options, expected):
    monkeypatch.setattr(runner, "run", None)
    with pytest.raises(EstimatorError, match=expected):
        prepared_cases(plan({"estimators": options}, tunable, "plain"), Workers(1))


def test_options_are_read_without_importing(tunable):
    import sys

    assert find(tunable).options() == {"gain": (), "mode": ()}
    assert find("plain").options() == {}
    assert "estimators_with_options.tunable" not in sys.modules
