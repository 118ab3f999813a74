"""Which variables of an incremental tree stay linearised where they are, since no recent frame has factors on them."""

from collections import deque
from collections.abc import Collection, Iterable, Set

import gtsam

from filters.smoothing.retired_variables import key_list


class FrozenVariables:
    """Which variables no recent frame has factors on, to be left where they are linearised.

    One that is seen again later stays frozen: its new factors are linearised where it was.
    """

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._recent: deque[set[int]] = deque()
        self._last_frame: dict[int, int] = {}
        self._last_view: dict[int, int] = {}
        self.count = 0
        self._frozen: set[int] = set()
        self._used: set[int] = set()
        self.keys = gtsam.KeyList()

    @property
    def others(self) -> Set[int]:
        """Return the variables that recent frames have factors on, but for those that were frozen before."""
        return self._used

    def unused_for(self, frames: int) -> list[int]:
        """Return the listed keys that none of the last so many frames has factors on, or in view."""
        oldest = self.count - frames
        return [key for key in self.keys if max(self._last_frame[key], self._last_view.get(key, 0)) < oldest]

    def see(self, landmarks: Iterable[int]) -> None:
        """Note what the next frame has in view, whether or not there will be factors on it."""
        self._last_view |= dict.fromkeys(landmarks, self.count)

    def leave(self, keys: Collection[int]) -> None:
        """Take keys off the list, which stay frozen."""
        self.keys = key_list(key for key in self.keys if key not in keys)

    def come_back(self, keys: Collection[int]) -> None:
        """Put keys on the list again."""
        self.keys = key_list([*self.keys, *keys])

    def add_frame(self, keys: Iterable[int]) -> None:
        """Count a frame whose factors are on some variables; freeze those of none of the last frames."""
        frame = set(keys)
        self._recent.append(frame)
        self._last_frame |= dict.fromkeys(frame, self.count)
        self._used |= frame - self._frozen
        if len(self._recent) > self._frames:
            oldest = self.count - self._frames
            for key in sorted(self._recent.popleft()):
                if self._last_frame[key] == oldest and key not in self._frozen:
                    self.keys.push_back(key)
                    self._frozen.add(key)
                    self._used.remove(key)
        self.count += 1
