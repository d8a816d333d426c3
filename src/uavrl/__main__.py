"""`python -m uavrl` is `uavrl`."""

import sys

from uavrl.cli import main

if __name__ == "__main__":
    sys.exit(main())
