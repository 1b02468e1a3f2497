"""``python -m concent_warp``: the same as ``concent``."""

import sys

from concent_warp.cli import main

if __name__ == "__main__":
    sys.exit(main())
