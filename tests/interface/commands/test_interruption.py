"""The process of a command: Ctrl-C in compiled code and in Python, of which what is kept is said; and its threads."""

import os
import signal
import subprocess
import sys

import pytest

from vggtjax.storage.process import give_devices_threads

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


def test_devices_of_a_split_cpu_have_threads_to_wait_and_to_compute(monkeypatch):
    flag = "--xla_force_host_platform_device_count"
    many = str(max(198, os.cpu_count() or 1))
    for flags, count, given, threads in (
        (f"--a=1 {flag}=99", "-1", None, many),
        (f"{flag}=99", "", "3", "3"),
        (f"{flag}=1", "", None, None),
        ("", "99", None, many),
        ("", "-1", None, None),
    ):
        with monkeypatch.context() as patch:
            patch.setenv("XLA_FLAGS", flags)
            patch.setenv("JAX_NUM_CPU_DEVICES", count)
            patch.delenv("PJRT_NPROC", raising=False)
            if given:
                patch.setenv("PJRT_NPROC", given)
            give_devices_threads()
            assert os.environ.get("PJRT_NPROC") == threads
            os.environ.pop("PJRT_NPROC", None)
