"""Coordinates that were rounded are told with their step and what it adds, and no others."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.tracks import coarse_pixels
from toolkit.geometry import Array
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate


def recording(scenario: str, seed: int = 3) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=4.0), seed)


def with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


@pytest.mark.parametrize("scenario", ["drive", "flight"])
def test_half_precision_numbers_are_named_with_the_step_they_have_there(scenario: str) -> None:
    sound = recording(scenario)
    uv_px = sound.observations.uv_px.astype(np.float16).astype(float)
    uv_px[:, 2] += 0.01  # the mean of two rows has finer steps
    found = coarse_pixels(Evidence(with_pixels(sound, uv_px)))
    assert isinstance(found, Symptom) and not found.harmful
    median_px = float(np.median(uv_px[:, 0]))
    step_px = 2.0 ** (np.floor(np.log2(median_px)) - 10)  # ten bits of a half-precision number's mantissa
    assert f"half-precision numbers, with steps of {step_px:g} px" in found.detail


@pytest.mark.parametrize("step_px", [1.0, 0.5, 0.1])
def test_the_step_of_rounded_pixels_adds_its_root_of_a_twelfth(step_px: float) -> None:
    sound = recording("drive")
    uv_px = np.round(sound.observations.uv_px / step_px) * step_px
    uv_px[::7, 1] = np.nan  # without a right image
    found = coarse_pixels(Evidence(with_pixels(sound, uv_px)))
    assert isinstance(found, Symptom) and not found.warns
    assert f"multiples of {step_px:g} px: rounding adds errors of {step_px / 12**0.5:.2g} px" in found.detail
    precise = faults.wrong_noise(with_pixels(sound, uv_px), 0.15)
    warned = coarse_pixels(Evidence(precise))
    assert isinstance(warned, Symptom) and warned.warns == (step_px / 12**0.5 > 0.5 * 0.15)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_what_has_more_digits_is_not_coarse(scenario: str) -> None:
    sound = recording(scenario)
    assert coarse_pixels(Evidence(sound)) is None
    single = sound.observations.uv_px.astype(np.float32).astype(float)
    assert coarse_pixels(Evidence(with_pixels(sound, single))) is None
