"""Images that come inside of another file, written to the disk one by one: the front end reads image files.

The folder is one of the cache's (``VISLAM_CACHE``); it goes when the spool is closed, is no longer used or the program
ends.
"""

import shutil
import tempfile
import weakref
from pathlib import Path

import numpy as np
import numpy.typing as npt

from toolkit.errors import OutputError
from toolkit.frontend.cache import folder


class ImageSpool:
    """A folder of images that is there as long as the spool is."""

    def __init__(self) -> None:
        try:
            folder().mkdir(parents=True, exist_ok=True)
            self.folder = Path(tempfile.mkdtemp(prefix="images-", dir=folder()))
        except OSError as error:
            raise _unwritable(error) from error
        self.close = weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def add_grey(self, name: str, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> Path:
        """Write grey values (height, width) of 8 or 16 bits as PGM and return the path; raises OutputError."""
        height, width = image.shape
        most = np.iinfo(image.dtype).max
        header = f"P5\n{width} {height}\n{most}\n".encode()
        # PGM has the high byte first.
        return self.add(f"{name}.pgm", header + image.astype(image.dtype.newbyteorder(">")).tobytes())

    def add(self, name: str, content: bytes) -> Path:
        """Write the content of an image file and return its path; raises OutputError where that cannot be."""
        path = self.folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise _unwritable(error) from error
        return path


def _unwritable(error: OSError) -> OutputError:
    why = error.strerror or error
    return OutputError(f"{folder()}: images cannot be kept there ({why}); name another folder with VISLAM_CACHE")
