"""`python -m v3dg` is the command line."""

import sys

from v3dg.cli import main

sys.exit(main())
