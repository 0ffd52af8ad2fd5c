"""How much memory is free: on a machine, and in a container that may have some of it only."""

from __future__ import annotations

import pytest

from crashhunt.base.resources import free_memory


@pytest.fixture
def machine(tmp_path):
    """Writes what the kernel says; returns the folder."""

    def write(**files):
        for folder in ("proc", "sys/fs/cgroup"):
            (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            place = "proc" if name == "meminfo" else "sys/fs/cgroup"
            (tmp_path / place / name.replace("_", ".")).write_text(text)
        return tmp_path

    return write


MEMINFO = "MemTotal:       8000 kB\nMemFree:         100 kB\nMemAvailable:   6000 kB\nHugePages_Total:       0\n"


def test_of_a_machine(machine):
    assert free_memory(machine(meminfo=MEMINFO)) == 0.75
    assert free_memory(machine(meminfo=MEMINFO, memory_max="max\n", memory_current="900\n")) == 0.75
    assert 0 < free_memory() <= 1


def test_of_a_container_files_that_are_only_kept_count_as_free(machine):
    given = {"meminfo": MEMINFO, "memory_max": "1000\n", "memory_current": "950\n"}
    assert free_memory(machine(**given)) == pytest.approx(0.05)
    assert free_memory(machine(**given, memory_stat="anon 400\ninactive_file 450\nactive_file 100\n")) == 0.5
    assert free_memory(machine(**given, memory_stat="inactive_file 990\n")) == 0.75


def test_where_no_one_can_say(tmp_path, machine):
    assert free_memory(tmp_path) == 1.0
    assert free_memory(machine(meminfo="odd\n")) == 1.0
