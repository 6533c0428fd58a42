"""`python -m vggtjax`, and the command `vggtjax`. Ctrl-C is answered in one line while modules are imported, too."""

import sys

from vggtjax.storage.interruption import answer_at_once, leave, message


def run() -> int:
    """Run the command line; return its exit code. A process that was interrupted ends at once."""
    answer_at_once()
    code = answered()
    if code == 130:
        leave()
    return code


def answered() -> int:
    """Run the command line, an interruption being an exit code."""
    try:
        from vggtjax.interface.commands.main import main

        return main()
    except KeyboardInterrupt:
        sys.stderr.write(f"vggtjax: {message()}\n")
        return 130


if __name__ == "__main__":
    sys.exit(run())
