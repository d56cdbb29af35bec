"""`python -m launch`: the same as `slipstream`."""

import sys

from launch.main import main

if __name__ == "__main__":
    sys.exit(main())
