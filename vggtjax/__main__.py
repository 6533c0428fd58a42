"""`python -m vggtjax`."""

import sys

from vggtjax.commands.main import main

sys.exit(main())
