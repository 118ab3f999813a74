"""``python -m toolkit.cli`` is ``vislam``."""

import sys

from toolkit.cli import main

sys.exit(main())
