"""Explanations find planted effects and nothing else, and say of an effect only what is more than chance (5 s)."""

from pathlib import Path

import numpy as np
import pytest

from toolkit.audit import Audit
from toolkit.experiment import recording
from toolkit.experiment.explanation import GATE, Explanation, run_explanation
from toolkit.experiment.pipeline import Plan
from toolkit.settings.reading import settings_of

# By how much the logarithm of the error falls with the one ingredient in which a pair of estimators differs.
PLANTED = {"salt": float(np.log(2.0)), "pepper": -0.4, "sugar": 0.15}
_ESTIMATOR = '''
"""Dead reckoning that jumps upwards, by a height that depends on what it has, and a little on seed and variant."""
from dataclasses import replace
from zlib import crc32
import numpy as np
from toolkit.estimate import Finished, Landmarks, Trajectory
from toolkit.models.state import predicted

INGREDIENTS = %(has)s
OPTIONS = {"water": (True, False), "salt": (True, False), "pepper": (True, False), "sugar": (True, False)}
WITHOUT = %(without)s

def build(setup):
    return Leaving(setup)

class Leaving:
    def __init__(self, setup):
        self.setup, self.answers = setup, []
        self.belief = setup.motion.initial_belief(setup.prior)

    def step(self, packet):
        if not self.answers:
            has = [name for name in INGREDIENTS if self.setup.options.get(name, True)]
            draw = np.random.default_rng([crc32(packet.frame.uvs_px.tobytes()), crc32(" ".join(has).encode())])
            self.jump_m = 2.0 * np.exp(0.015 * draw.standard_normal() - sum(%(by)s.get(name, 0.0) for name in has))
        self.belief = predicted(self.belief, self.setup.motion, packet.motion)
        answer = self.belief.estimate(packet.frame.t_ns)
        pose = answer.T_world_imu.copy()
        pose[2, 3] += self.jump_m * (packet.index >= 4)
        self.answers.append(replace(answer, T_world_imu=pose))
        return self.answers[-1]

    def finish(self):
        return Finished(Trajectory.of(self.answers), Landmarks.none())
'''


def written(folder: Path, name: str, has: tuple[str, ...], planted: str) -> str:
    """Write an estimator with some ingredients, of which one has an effect, and return its path."""
    text = _ESTIMATOR % {"has": has, "without": {one: {one: False} for one in has}, "by": {planted: PLANTED[planted]}}
    (folder / f"{name}.py").write_text(text.lstrip())
    return str(folder / f"{name}.py")


@pytest.fixture(autouse=True)
def without_audit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes most of the time and finds nothing in these recordings."""
    monkeypatch.setattr(recording, "audit", lambda sequence, _keep=frozenset(): Audit(sequence, ()))


def explanation_of(folder: Path, planted: str) -> Explanation:
    """Return why an estimator with two ingredients differs from one that lacks the one that has an effect."""
    names = written(folder, "plain", ("water",), planted), written(folder, "full", ("water", planted), planted)
    plan = Plan(("drive",), names, settings=settings_of({"seeds": 4}, "here"), max_frames=8, workers=1)
    return run_explanation(plan, *names)


@pytest.mark.parametrize("planted", PLANTED)
def test_a_planted_ingredient_is_found_with_its_size_and_no_other_is(planted, tmp_path):
    found = explanation_of(tmp_path, planted)
    assert {part.ingredient for part in found.parts} == {planted, "water", GATE}
    for part in found.parts:
        for effect in (part.first_in, part.last_in):
            factor = np.exp(PLANTED[planted]) if part.ingredient == planted else 1.0
            assert effect.error.low <= factor <= effect.error.high, part.ingredient
            assert effect.shown == (part.ingredient == planted)
