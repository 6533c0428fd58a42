"""`python -m vggtjax`, and the command `vggtjax`. Ctrl-C is answered in one line while modules are imported, too."""

import sys


def run() -> int:
    """Run the command line; return its exit code."""
    try:
        from vggtjax.commands.main import main

        return main()
    except KeyboardInterrupt:
        sys.stderr.write("vggtjax: interrupted\n")
        return 130


if __name__ == "__main__":
    sys.exit(run())
