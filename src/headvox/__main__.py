"""``python -m headvox`` is the command ``headvox``."""

import sys

from headvox.cli import main

sys.exit(main())
