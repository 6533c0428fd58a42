"""The settings of its process that a command makes."""

import os

from vggtjax.interface.commands.process import give_devices_threads


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
