"""`python -m vggtjax`."""

import sys

from vggtjax.cli import main

sys.exit(main())
