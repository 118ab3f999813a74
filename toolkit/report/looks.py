"""The look of an estimator, its colour and dashes: the same in every figure and page of every run."""

from collections.abc import Iterable

from toolkit.registry import defaults, discover, ladder

# How many colours there are; a number beyond them has the colours over again, in other dashes.
COLOURS = 7


def look_numbers(compared: Iterable[str]) -> dict[str, int]:
    """Return the number of the look of each estimator that is compared, whatever it is compared with.

    Those of this installation have the first numbers: the default ones, then the ladder, then others by name. All
    others, as a file of one's own, have dashes that none of these have, and first colours that no default one has.
    """
    here = list(dict.fromkeys((*defaults(), *(entry.name for entry in ladder()), *discover())))
    own = [name for name in dict.fromkeys(compared) if name not in here]
    first_own = -(-len(here) // COLOURS) * COLOURS + len(defaults())
    return {name: i for i, name in enumerate(here)} | {name: first_own + i for i, name in enumerate(own)}
