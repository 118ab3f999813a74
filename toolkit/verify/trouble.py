"""What a recording may hold, planted by :mod:`toolkit.simulation.faults`; no estimator may die of it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

from toolkit import runner
from toolkit.estimator import Build
from toolkit.experiment.recording import Recording, prepare
from toolkit.progress import SILENT
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, Scenario, faults, simulate
from toolkit.verify.promises import gave_up

SEED = 4
DURATION_S, MAX_TRACKS = 6.0, 40

# By what a user calls it; each as the audit leaves it, as before every comparison.
TROUBLE: Mapping[str, Callable[[Sequence], Sequence]] = {
    "a fifth of the sightings lost": partial(faults.dropped_sightings, dose=0.2),
    "2 s without sight": partial(faults.blackout, dose=2.0),
    "nothing ever seen": partial(faults.dropped_sightings, dose=1.0),
    "one track a frame": partial(faults.few_tracks, dose=1.0),
    "30 % outlier tracks": faults.outlier_tracks,
    "all seen to one side": faults.one_sided_view,
    "left and right swapped in a fifth of the tracks": partial(faults.swapped_images, dose=0.2),
    "0.5 s without motion samples": faults.motion_gap,
    "0.25 s that is not a number": faults.nan_span,
    "a clock that jumps back": faults.clock_jump,
    "a camera 20 ms late": faults.camera_clock,
    "a camera turned by 3 degrees": faults.turned_camera,
    "a gyro bias of 0.05 rad/s": partial(faults.gyro_bias, dose=0.05),
    "half the noise stated": partial(faults.wrong_noise, dose=0.5),
}


def short(scenario: Scenario, duration_s: float = DURATION_S) -> Scenario:
    """Return a scenario of a few seconds and forty tracks a frame: they come and go, and every estimator is quick."""
    return replace(scenario, duration_s=duration_s, camera=replace(scenario.camera, max_tracks=MAX_TRACKS))


def deaths(name: str, build: Build) -> dict[str, str]:
    """Return, by the trouble it was in, why an estimator did not go on to the end."""
    found = {}
    for scenario in (DRIVE, FLIGHT):
        sound = simulate(short(scenario), SEED)
        for trouble, plant in TROUBLE.items():
            prepared = prepare(Recording(plant(sound)))
            run = runner.run(name, build, prepared.sequence, prepared.prior, SILENT)
            if why := gave_up(run, prepared.sequence.frames_t_ns):
                found[f"{trouble} ({scenario.name})"] = why
    return found
