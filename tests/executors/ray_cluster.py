"""A Ray cluster of several nodes on this machine, for tests."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ray.cluster_utils import Cluster


@contextlib.contextmanager
def head() -> Iterator[Cluster]:
    """A cluster with a head that runs nothing."""
    from ray.cluster_utils import Cluster  # whoever has no Ray skips these tests

    with (
        tempfile.TemporaryDirectory(prefix="chr-", dir="/tmp") as short,  # Ray makes sockets there
        pytest.MonkeyPatch.context() as patched,
    ):
        Path(short, "ray").mkdir()
        patched.setenv("RAY_TMPDIR", short)  # where it says which cluster is the current one
        arguments = {"num_cpus": 0, "include_dashboard": False, "temp_dir": short}
        found = Cluster(initialize_head=True, head_node_args=arguments)
        yield found
        found.shutdown()


@contextlib.contextmanager
def nodes(cluster: Cluster) -> Iterator[list]:
    """A list of added nodes, which are removed in the end."""
    added: list = []
    yield added
    for one in added:
        with contextlib.suppress(Exception):
            cluster.remove_node(one)


def below(pid: int) -> list[int]:
    """Return all processes below one."""
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[1]) == pid:
                found += [int(stat.parent.name), *below(int(stat.parent.name))]
    return found
