"""Which variables of an incremental graph no recent frame concerns, to be left where they are linearised."""

from collections import deque
from collections.abc import Iterable

import gtsam


class Resting:
    """Takes note of the variables each frame concerns; those of none of the last frames rest.

    One that is seen again later rests on: its new factors are linearised where it was.
    """

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._recent: deque[set[int]] = deque()
        self._last_frame: dict[int, int] = {}
        self._count = 0
        self._at_rest: set[int] = set()
        self.keys = gtsam.KeyList()

    def all_of(self, keys: Iterable[int]) -> bool:
        """Say whether all of some variables rest."""
        return self._at_rest.issuperset(keys)

    def concerns(self, keys: Iterable[int]) -> None:
        """Take note of the variables a new frame concerns."""
        frame = set(keys)
        self._recent.append(frame)
        self._last_frame |= dict.fromkeys(frame, self._count)
        if len(self._recent) > self._frames:
            oldest = self._count - self._frames
            for key in sorted(self._recent.popleft()):
                if self._last_frame[key] == oldest:
                    self.keys.push_back(key)
                    self._at_rest.add(key)
        self._count += 1
