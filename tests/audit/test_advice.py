"""Whoever changes a recording as a finding of the audit says has none of that kind (3 s)."""

import re
from collections.abc import Callable

import numpy as np
import pytest

from tests.advice import TOOLKIT, advice_in, is_followed
from tests.audit.conftest import clean_recording, with_observations
from tests.audit.test_fault_table import normalised, one_camera
from toolkit.audit import FAULTS, name_of
from toolkit.audit.fault import Evidence, Symptom
from toolkit.sequence import Sequence

# A step makes another recording of one; what follows an advice has the words of the finding besides.
Plant, Follow = Callable[[Sequence], Sequence], Callable[[Sequence, str], Sequence]
FILLED = slice(0, None, 4)


def filled(columns: list[int], value: float) -> Plant:
    def plant(sequence: Sequence) -> Sequence:
        uv_px = sequence.observations.uv_px.copy()
        uv_px[FILLED, columns] = value
        return with_observations(sequence, uv_px=uv_px)

    return plant


def in_pixels(sequence: Sequence, _: str) -> Sequence:
    rig = sequence.rig
    f_px, c_px = np.array([rig.fx_px, rig.fx_px, rig.fy_px]), np.array([rig.cx_px, rig.cx_px, rig.cy_px])
    return with_observations(sequence, uv_px=sequence.observations.uv_px * f_px + c_px)


def left_alone(sequence: Sequence, _: str) -> Sequence:
    uv_px = sequence.observations.uv_px.copy()
    uv_px[uv_px[:, 1] == uv_px[:, 0], 1] = np.nan
    uv_px[uv_px[:, 1] < 0.0, 1] = np.nan
    return with_observations(sequence, uv_px=uv_px)


def without_rows(sequence: Sequence, _: str) -> Sequence:
    return with_observations(sequence, (sequence.observations.uv_px != 0.0).any(axis=1))


ROWS: list[tuple[str, Plant, str, Follow]] = [
    ("drive", lambda s: normalised(s, 1.0, 0), "write fx_px u + cx_px and fy_px v + cy_px for them", in_pixels),
    ("drive", lambda s: one_camera(s, 1.0, 0), "correct the file, or leave uR empty", left_alone),
    ("drive", filled([1], -1.0), "leave uR empty where there is none", left_alone),
    ("drive", filled([0, 1, 2], 0.0), "and leave their rows out of a table", without_rows),
]
# What is to be mended where the recording is made, so that what is then read is the sound one.
AT_THE_SOURCE = re.compile(
    r"^(check|correct (it|them|K|the (file|stamps|recording))|choose one|cut (off|it there|the recording)|do not"
    r"|give them the same|record the|run backwards, jump|stamp (both by one clock|rates|them when)"
    r"|leave (it|them) out|or leave the|state the densities|use a sensor"
    r"|write (all the digits|the orientations|them (with all|in the order)|the truth in the axes))"
)


CHECKS = {"intrinsics", "swapped-coordinates", "no-disparity", "left-only"}


def told_of(sequence: Sequence) -> str:
    """Return what the checks that give these advices say of a recording."""
    evidence = Evidence(sequence)
    found = {name_of(check): check(evidence) for check in FAULTS if name_of(check) in CHECKS}
    return " ".join(f"{one.detail}; {one.treatment}" for one in found.values() if isinstance(one, Symptom))


def test_every_advice_of_the_audit_is_followed_or_is_for_where_it_was_recorded() -> None:
    told = {one for one in advice_in((TOOLKIT / "audit").glob("*.py")) if not AT_THE_SOURCE.match(one)}
    assert not [one for one in told if not is_followed(one, [advice for _, _, advice, _ in ROWS])]


@pytest.mark.parametrize(("scenario", "plant", "advice", "follow"), ROWS, ids=[row[2] for row in ROWS])
def test_who_follows_the_audit_has_no_such_finding(scenario: str, plant: Plant, advice: str, follow: Follow) -> None:
    with np.errstate(all="ignore"):
        planted = plant(clean_recording(scenario))
        told = told_of(planted)
        assert advice in told
        assert advice not in told_of(follow(planted, told))
