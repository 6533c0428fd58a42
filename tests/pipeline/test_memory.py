"""What is predicted of memory, beside XLA's own count, and what is read of the system."""

import pytest

from vggtjax.config import vggt_1b
from vggtjax.pipeline import memory
from vggtjax.pipeline.free_memory import host_bytes
from vggtjax.pretrained.embedded import demo_model


@pytest.mark.parametrize(
    ("config", "frames", "size", "counted"),  # temporary bytes of the first pass by XLA's count for a CPU
    [
        (demo_model().config, 16, (64, 64), 16_779_952),
        (demo_model().config, 64, (64, 64), 67_111_600),
        (vggt_1b(), 8, (294, 518), 493_673_248),
        (vggt_1b(), 32, (294, 518), 1_382_190_560),
        (vggt_1b(), 8, (392, 518), 658_206_752),
        (vggt_1b(), 8, (518, 518), 869_748_832),
        (vggt_1b(), 32, (518, 518), 2_610_586_656),
    ],
)
def test_the_passes_are_predicted_within_a_third_of_the_counts_of_xla(config, frames, size, counted):
    assert memory.pass_bytes(config, frames, *size) == pytest.approx(counted, rel=1 / 3)


def test_free_memory_is_the_least_of_the_host_and_the_control_groups(tmp_path):
    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    assert host_bytes(tmp_path) is None
    write("proc/meminfo", "MemTotal: 2000 kB\nMemAvailable: 1000 kB\n")
    write("proc/self/status", "Name: python\nVmRSS: 100 kB\n")
    assert host_bytes(tmp_path) == 1100 * 1024
    write("proc/self/cgroup", "4:memory:/a/b\n0::/c/d\n")
    write("sys/fs/cgroup/memory/a/memory.limit_in_bytes", f"{900 * 1024}")
    write("sys/fs/cgroup/memory/a/memory.usage_in_bytes", f"{200 * 1024}")
    write("sys/fs/cgroup/memory/a/memory.stat", f"total_inactive_file {50 * 1024}\n")
    write("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712")
    write("sys/fs/cgroup/memory/memory.usage_in_bytes", "5")
    assert host_bytes(tmp_path) == (100 + 750) * 1024
    write("sys/fs/cgroup/c/memory.max", f"{300 * 1024}")
    write("sys/fs/cgroup/c/memory.current", f"{100 * 1024}")
    write("sys/fs/cgroup/c/d/memory.max", "max")
    assert host_bytes(tmp_path) == (100 + 200) * 1024
