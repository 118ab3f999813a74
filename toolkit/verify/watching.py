"""A run that is watched: what went into an estimator and what came out, each with a copy made at that moment."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from toolkit.estimate import Estimate, Finished
from toolkit.estimator import Build, Setup
from toolkit.geometry import Array
from toolkit.sequence import Packet, Sequence
from toolkit.settings import DEFAULTS, Scalar, Settings


@dataclass(frozen=True, eq=False)
class Watched:
    """One run over a recording: the setup and packets, every answer, what was said in the end; copies of all before."""

    sequence: Sequence
    setup: Setup
    packets: tuple[Packet, ...]
    given_copies: tuple[Array, ...]
    online: tuple[Estimate | None, ...]
    online_copies: tuple[tuple[Array, ...], ...]
    finished: Finished


def setup_of(sequence: Sequence, settings: Settings = DEFAULTS, options: dict[str, Scalar] | None = None) -> Setup:
    """Return what an estimator is told of a recording that states its own prior, as a simulated one does."""
    assert sequence.prior is not None
    return Setup(
        sequence.rig,
        sequence.noise,
        sequence.prior,
        sequence.gravity_world,
        sequence.motion_kind,
        settings,
        options or {},
    )


def watch(build: Build, sequence: Sequence) -> Watched:
    """Run an estimator over a recording from its own prior; whatever the estimator raises passes through."""
    setup, packets = setup_of(sequence), tuple(sequence.packets())
    given_copies = copies_of((setup, packets))
    estimator, online, online_copies = build(setup), list[Estimate | None](), list[tuple[Array, ...]]()
    for packet in packets:
        online.append(estimator.step(packet))
        online_copies.append(copies_of(online[-1]))
    finished = estimator.finish()
    return Watched(sequence, setup, packets, given_copies, tuple(online), tuple(online_copies), finished)


def answers(build: Build, sequence: Sequence) -> Iterator[Estimate | None]:
    """Yield an estimator's answer to each packet of a recording."""
    estimator = build(setup_of(sequence))
    for packet in sequence.packets():
        yield estimator.step(packet)


def arrays_of(value: object) -> Iterator[Array]:
    """Yield every array in a value of toolkit.estimate or toolkit.sequence."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from arrays_of(item)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from arrays_of(getattr(value, field.name))


def copies_of(value: object) -> tuple[Array, ...]:
    """Return a copy of every array in a value."""
    return tuple(array.copy() for array in arrays_of(value))
