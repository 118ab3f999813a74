"""The estimator to verify, and properties that a watched run of it must have.

Of a property each function returns a sentence about what is wrong, or an empty text.

Of a watched run all inputs and outputs of the estimator are kept, each with a copy made at that moment.
"""

import importlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import zip_longest
from typing import cast

import numpy as np

from toolkit import runner
from toolkit.answers import COV_SIZES, Run, check_state
from toolkit.discovery import shown_name
from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate, Finished
from toolkit.estimator import Build, Setup
from toolkit.geometry import Array, IntArray
from toolkit.measurements import Packet
from toolkit.metrics.parts.consistency import POSE_DOF
from toolkit.models.gating import chi2_bound
from toolkit.registry import cannot_import, discover, find
from toolkit.sequence import Sequence

_MODULE = re.compile(r"\w+(\.\w+)+")
# Rounding of some hundred products of rotations.
_ROTATION_TOLERANCE = 1e-12
# Of a product that is symmetric but for rounding, in units of the standard deviations.
_SYMMETRY_TOLERANCE = 1e-9
# False alarm rate of the test of mean NEES.
_FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class Subject:
    """An estimator to verify: its name, and what loads its ``build``."""

    name: str
    load: Callable[[], Build]


def subject_of(word: str) -> Subject:
    """Return the estimator that an argument names: ``my_filter.py``, ``my_package.my_filter`` or ``ekf``.

    Loading it raises EstimatorError where the file cannot be imported or has no function ``build(setup)``. Raises
    EstimatorError where the argument names nothing.
    """
    if _MODULE.fullmatch(word) and not word.endswith(".py") and word not in discover():
        return Subject(shown_name(word), lambda: _build_of(word))
    entry = find(word)
    return Subject(entry.name, entry.load)


def _build_of(word: str) -> Build:
    try:
        module = importlib.import_module(word)
    except (Exception, SystemExit) as error:  # a script may end where it is imported
        raise cannot_import(word, error) from error
    if not callable(getattr(module, "build", None)):
        raise EstimatorError(f"{word}: it defines no function build(setup)")
    return cast(Build, module.build)


@dataclass(frozen=True, eq=False)
class Watched:
    """One run over a recording: setup, packets, every answer and the result of ``finish``, with copies of each."""

    build: Build
    sequence: Sequence
    setup: Setup
    packets: tuple[Packet, ...]
    given_copies: tuple[Array, ...]
    online: tuple[Estimate | None, ...]
    online_copies: tuple[tuple[Array, ...], ...]
    finished: Finished


def setup_of(sequence: Sequence) -> Setup:
    """Return the setup of an estimator for a recording with its own prior, as a simulated one has."""
    assert sequence.prior is not None
    return runner.setup_of(sequence, sequence.prior)


def watch(build: Build, sequence: Sequence) -> Watched:
    """Run an estimator over a recording from its own prior; whatever the estimator raises passes through.

    Raises EstimatorError where an answer is no Estimate, or its pose, velocity or biases have no such shape.
    """
    setup, packets = setup_of(sequence), tuple(sequence.packets())
    given_copies = copies_of((setup, packets))
    estimator, online, online_copies = build(setup), list[Estimate | None](), list[tuple[Array, ...]]()
    for packet in packets:
        answer = estimator.step(packet)
        if answer is not None:
            check_state(answer, packet.index)
        online.append(answer)
        online_copies.append(copies_of(online[-1]))
    finished = estimator.finish()
    return Watched(build, sequence, setup, packets, given_copies, tuple(online), tuple(online_copies), finished)


def declines(build: Build, sequence: Sequence) -> str:
    """Return what an estimator says of an input that it is not made for; empty where it takes it.

    That is an EstimatorError in ``build`` or before it has answered for the first motion. Any other error is none.
    """
    try:
        for index, _ in enumerate(answers(build, sequence)):
            if index == 1:
                break
    except EstimatorError as error:
        return str(error)
    except Exception:  # anybody's code, which may raise anything; to run it again tells what
        return ""
    return ""


def answers(build: Build, sequence: Sequence) -> Iterator[Estimate | None]:
    """Yield an estimator's answer to each packet of a recording."""
    estimator = build(setup_of(sequence))
    for packet in sequence.packets():
        yield estimator.step(packet)


def arrays_of(value: object) -> Iterator[Array]:
    """Yield every array in a value of toolkit.estimate or toolkit.sequence."""
    for _, array in _named_arrays(value, ""):
        yield array


def _named_arrays(value: object, name: str) -> Iterator[tuple[str, Array]]:
    if isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, tuple):
        for item in value:
            yield from _named_arrays(item, name)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _named_arrays(getattr(value, field.name), field.name)


def copies_of(value: object) -> tuple[Array, ...]:
    """Return a copy of every array in a value."""
    return tuple(array.copy() for array in arrays_of(value))


def look_ahead(watched: Watched) -> str:
    """Say at which frame an answer changes when later packets are withheld."""
    for count in (2, len(watched.online) // 2):
        early = answers(watched.build, watched.sequence.truncated(count))
        for k, (answer, full) in enumerate(zip(early, watched.online, strict=False)):
            if found := difference(answer, full):
                where = f"its answer to frame {k} differs where the packets from frame {count} on are withheld"
                return f"{where}: {found}"
    return ""


def other_answers(first: Watched, packets: tuple[Packet, ...] = ()) -> str:
    """Say at which frame a second run over the same packets, or others that are equal, gives another answer."""
    estimator = first.build(first.setup)
    for k, (packet, before) in enumerate(zip(packets or first.packets, first.online, strict=True)):
        if found := difference(estimator.step(packet), before):
            return f"a second run differs at frame {k}: {found}"
    found = difference(estimator.finish(), first.finished)
    return f"a second run has another final result: {found}" if found else ""


def difference(one: Estimate | Finished | None, other: Estimate | Finished | None) -> str:
    """Say how two answers differ; empty where all bits are the same."""
    if (one is None) != (other is None):
        return "one run returns an estimate and the other does not"
    pairs = list(zip_longest(_named_arrays(one, ""), _named_arrays(other, "")))
    if any(left is None or right is None or left[1].shape != right[1].shape for left, right in pairs):
        return "other fields or shapes"
    if differing := [_where(name, left, right) for (name, left), (_, right) in pairs if not _same(left, right)]:
        return "; ".join(differing)
    if isinstance(one, Estimate) and isinstance(other, Estimate):
        return _difference_of_info(one, other)
    return ""


def _difference_of_info(one: Estimate, other: Estimate) -> str:
    ours, theirs = dict(one.info), dict(other.info)
    same = ours.keys() == theirs.keys() and all(
        np.array_equal(value, theirs[key], equal_nan=True) for key, value in ours.items()
    )
    return "" if same else "its diagnostics (info) differ"


def _same(left: Array, right: Array) -> bool:
    return np.array_equal(left, right, equal_nan=True)


def _where(name: str, left: Array, right: Array) -> str:
    """Say which array differs, by how much at most, in how many of its numbers and from which place on."""
    places = np.argwhere((left != right) & ~(np.isnan(left) & np.isnan(right)))
    first, most = ", ".join(map(str, places[0].tolist())), _largest(left, right)
    return f"{name} differs by {most:.3g} at most, in {len(places)} of {left.size} numbers, the first [{first}]"


def _largest(left: Array, right: Array) -> float:
    with np.errstate(all="ignore"):
        return float(np.nanmax(np.abs(left - right), initial=0.0))


def changed_later(watched: Watched) -> str:
    """Say which answer changed after it was given."""
    for k, (answer, copies) in enumerate(zip(watched.online, watched.online_copies, strict=True)):
        for array, copy in zip(arrays_of(answer), copies, strict=True):
            if not np.array_equal(array, copy, equal_nan=True):
                return f"its answer to frame {k} changed after it was given, by {_largest(array, copy):.3g}"
    return ""


def touched(watched: Watched) -> str:
    """Say whether the setup or a packet was written to."""
    given = (watched.setup, watched.packets)
    for array, copy in zip(arrays_of(given), watched.given_copies, strict=True):
        if not np.array_equal(array, copy, equal_nan=True):
            return f"it wrote into what it was given: an array of shape {array.shape} has changed"
    return ""


def not_finite(watched: Watched) -> str:
    """Say at which frame a pose, velocity or bias is no number."""
    for k, answer in enumerate(watched.online):
        for name in ("T_world_imu", "v_world", "bias"):
            value = None if answer is None else getattr(answer, name)
            if value is not None and not np.isfinite(value).all():
                return f"{name} of its answer to frame {k} is not finite"
    trajectory = watched.finished.trajectory
    for name in ("T_world_imu", "v_world", "bias"):
        values = getattr(trajectory, name)
        if values is not None and not np.isfinite(values).all():
            first = int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))
            return f"{name} {first} of its final trajectory is not finite"
    points = watched.finished.landmarks.points_world
    return "" if np.isfinite(points).all() else "a landmark of its map is not finite"


def states_covariance(watched: Watched) -> bool:
    """Say whether any answer has a covariance."""
    return any(True for _ in _stated(watched))


def unsound_covariance(watched: Watched) -> str:
    """Say which covariance is not finite, of a wrong size, not symmetric or not positive definite."""
    landmarks = watched.finished.landmarks.cov
    of_landmarks = ((f"landmark {i}", cov) for i, cov in enumerate(() if landmarks is None else landmarks))
    for stated, sizes in ((_stated(watched), COV_SIZES), (of_landmarks, (3,))):
        for where, cov in stated:
            if found := covariance_fault(cov, sizes):
                return f"the covariance of {where} {found}"
    return ""


def _stated(watched: Watched) -> Iterator[tuple[str, Array]]:
    for k, answer in enumerate(watched.online):
        if answer is not None and answer.cov is not None:
            yield f"its answer to frame {k}", answer.cov
    finals = watched.finished.trajectory.cov
    for k, cov in enumerate(() if finals is None else finals):
        yield f"its final state {k}", cov


def covariance_fault(cov: Array, sizes: tuple[int, ...]) -> str:
    """Say what is wrong with a covariance (d, d), d one of the sizes; nothing where it is sound.

    Units differ by orders of magnitude: what must be positive definite is the matrix of correlations.
    """
    if cov.ndim != 2 or cov.shape[0] != cov.shape[1] or len(cov) not in sizes:
        return f"has the shape {cov.shape}; expected {' or '.join(f'{n} x {n}' for n in sizes)}"
    if not np.isfinite(cov).all():
        return "is not finite"
    variances = np.diagonal(cov)
    if (variances <= 0.0).any():
        return f"has the variance {variances.min():.3g} in row {int(variances.argmin())}"
    sigmas = np.sqrt(variances)
    correlations = cov / np.outer(sigmas, sigmas)
    off = _largest(correlations, correlations.T)
    if off > _SYMMETRY_TOLERANCE:
        return f"is not symmetric: it differs from its transpose by {off:.3g} times the standard deviations"
    least = float(np.linalg.eigvalsh(correlations)[0])
    return "" if least > 0.0 else f"is not positive definite: its least eigenvalue is {least:.3g} times its scale"


def no_rotation(watched: Watched) -> str:
    """Say which pose has a matrix that is not a rotation."""
    poses = [answer.T_world_imu for answer in watched.online if answer is not None]
    stacked = np.concatenate([np.array(poses).reshape(-1, 4, 4), watched.finished.trajectory.T_world_imu])
    rotations = stacked[:, :3, :3]
    with np.errstate(all="ignore"):
        off = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~(off < _ROTATION_TOLERANCE))
    return (
        "" if not bad.size else f"{bad.size} of {len(stacked)} rotations are none: R R^T is off by {off[bad].max():.3g}"
    )


def wrong_stamps(watched: Watched) -> str:
    """Say at which frame an answer is missing, or has the stamp of another frame."""
    frames_t_ns = watched.sequence.frames_t_ns
    silent = sum(answer is None for answer in watched.online)
    if silent not in (0, len(watched.online)):
        return f"it answers at {len(watched.online) - silent} of {len(watched.online)} frames; answer at each, or none"
    for k, answer in enumerate(watched.online):
        if answer is not None and answer.t_ns != frames_t_ns[k]:
            return f"its answer to frame {k} has the stamp {answer.t_ns} ns, the frame has {frames_t_ns[k]} ns"
    final = watched.finished.trajectory
    if not np.array_equal(final.t_ns, frames_t_ns) or final.T_world_imu.shape != (frames_t_ns.size, 4, 4):
        return (
            f"its final trajectory has {len(final)} states, and there are {frames_t_ns.size} frames with their stamps"
        )
    return ""


def gave_up(run: Run, frames_t_ns: IntArray) -> str:
    """Say why a run did not go on to the end. A run that reports divergence with a reason did."""
    if run.status not in ("ok", "diverged"):
        return run.log[0] if run.log else f"it {run.status}"
    if run.status != "ok" and not run.log:
        return "it diverged and does not say why"
    if run.final is None:
        return "it has no final trajectory"
    for output, trajectory in (("causal", run.causal), ("final", run.final)):
        if trajectory is not None and not np.array_equal(trajectory.t_ns, frames_t_ns):
            return f"its {output} trajectory has {len(trajectory)} states, and there are {frames_t_ns.size} frames"
        if trajectory is not None and not np.isfinite(trajectory.T_world_imu).all():
            return f"its {output} trajectory is not finite"
    return ""


def inconsistency(nees_means: list[float]) -> str:
    """Say whether mean pose NEES over 6, one a run, are above or below a consistent estimator's by more than chance.

    The band is for poses of a run that share one error, the worst case, and holds 99.9 % of consistent estimators.
    """
    dof = POSE_DOF * len(nees_means)
    low, high = (float(chi2_bound(dof, p)) / dof for p in (0.5 * _FALSE_ALARM, 1.0 - 0.5 * _FALSE_ALARM))
    mean = float(np.mean(nees_means))
    if low <= mean <= high:
        return ""
    how = "overconfident" if mean > high else "less certain than it could be"
    return (
        f"it is {how}: mean pose NEES {mean:.3g}, and {low:.2f} to {high:.2f} contains 99.9 % of consistent estimators"
    )
