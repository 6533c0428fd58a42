"""Ctrl-C while the main thread is in compiled code, and while it is in Python: what is kept is said, and it ends."""

import signal
import subprocess
import sys

import pytest

_WORK = """
import hashlib, signal, sys, time
import vggtjax.interface.commands.main
from vggtjax.__main__ import run
from vggtjax.storage.interruption import handled, kept

def work():
    {before}
    with kept(lambda: "1 of 3 windows are kept"):
        {work}
    return 5

vggtjax.interface.commands.main.main = work
sys.exit(run())
"""
_WORKS = 'print("working", flush=True); '
_COMPILED = _WORKS + 'hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)'  # for minutes, as XLA; no signal is heard in it
_PYTHON = _WORKS + "time.sleep(600)"
_SERVER = """
        try:
            print("working", flush=True); time.sleep(600)
        except KeyboardInterrupt:
            handled()
            time.sleep(3)
"""
_OWN = "signal.signal(signal.SIGINT, lambda *_: sys.exit(7))"


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.parametrize(
    ("before", "work", "code", "said"),
    [
        ("pass", _COMPILED, 130, "vggtjax: interrupted; 1 of 3 windows are kept\n"),
        ("pass", _PYTHON, 130, "vggtjax: interrupted; 1 of 3 windows are kept\n"),
        ("pass", _SERVER, 5, ""),  # its normal end, which may take a while
        (_OWN, _PYTHON, 7, ""),  # a handler of the program's own, as training has one, is left alone
    ],
)
def test_an_interruption_ends_the_process_and_says_what_is_kept(before, work, code, said):
    program = _WORK.format(before=before, work=work)
    process = subprocess.Popen([sys.executable, "-c", program], stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "working\n"
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20)[1] == said
    assert process.returncode == code
