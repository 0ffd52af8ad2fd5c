"""``trained_on.json``: which traffics a policy was trained on. It lies next to the policy, and snapshots carry it.

A comparison on these traffics shows what the policy has learned by heart. `held_out_traffics` returns the rule by which
`crashhunt compare`, `gate` and `rate` keep only the traffics of the test part, whatever their outcome.
"""

from __future__ import annotations

import fcntl
import json
import os
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import parse_object, typed
from crashhunt.snapshots import Snapshot
from crashhunt.training._split import is_test_traffic

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from crashhunt.plans import HuntSettings

__all__ = ["HeldOutTraffics", "TrainedOn", "held_out_traffics", "read_trained_on"]

_SCHEMA = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedOn:
    """The traffics that a policy was trained on.

    Args:
        test: share of the test part, which the training never uses.
        seeds: seeds of the crashes that were trained on.
        hunt_seeds: seeds of the hunts that found them. Survived traffics of these hunts are split as well.
    """

    test: float
    seeds: frozenset[int] = frozenset()
    hunt_seeds: frozenset[int] = frozenset()

    def write(self, path: Path) -> None:
        """Write the file; add to one that exists already. Several processes may do so at once.

        Raises:
            UsageError: the existing file has another split.
            HuntDirectoryError: the file is damaged or cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # A lock of the folder leaves no further file next to the policy.
            with _locked(path.parent):
                before = read_trained_on(path) if path.exists() else self
                if before.test != self.test:
                    raise UsageError(
                        f"{path} records a training with test={before.test:g}, but this training has "
                        f"test={self.test:g}",
                        fix="use the same test share, or name another file",
                    )
                if path.exists() and self.seeds <= before.seeds and self.hunt_seeds <= before.hunt_seeds:
                    return
                data = {
                    "schema": _SCHEMA,
                    "test": self.test,
                    "hunt_seeds": sorted(self.hunt_seeds | before.hunt_seeds),
                    "seeds": sorted(self.seeds | before.seeds),
                }
                with whole_file(path) as temporary:
                    temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise HuntDirectoryError(
                f"cannot be written: {error.strerror}", fix="name a file in a writable folder", where=str(path)
            ) from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which dies with this process."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def read_trained_on(path: Path) -> TrainedOn:
    """Read ``trained_on.json``.

    Raises:
        HuntDirectoryError: it is missing or damaged.
    """
    try:
        data: dict[str, Any] = parse_object(path.read_bytes(), dict)
        typed(data, {"schema": int, "seeds": list[int], "hunt_seeds": list[int]})
        test = float(data["test"])
        if data["schema"] != _SCHEMA or not 0 <= test < 1:
            raise ValueError(f"schema {data['schema']}, test {test:g}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise HuntDirectoryError(
            f"cannot be read: {reason}",
            fix="restore it: without it, the training traffics are unknown",
            where=str(path),
        ) from None
    return TrainedOn(test=test, seeds=frozenset(data["seeds"]), hunt_seeds=frozenset(data["hunt_seeds"]))


@dataclass(frozen=True, slots=True)
class HeldOutTraffics:
    """The traffics of a hunt that no agent in a comparison was trained on.

    Args:
        hunt_seed: seed of the hunt.
        records: records of the agents.
    """

    hunt_seed: int
    records: tuple[TrainedOn, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether no traffic of the hunt can be held out: an agent was trained on the hunt without a test part."""
        return any(not record.test and self.hunt_seed in record.hunt_seeds for record in self.records)

    def has(self, seed: int) -> bool:
        """Return whether a comparison may use the traffic of a seed.

        In a hunt that was trained on, only the hash decides. To remove only the crashes that were trained on would
        leave the survived traffics of the training part, and favour the version before the training.
        """
        return all(
            is_test_traffic(seed, record.test)
            or not (self.hunt_seed in record.hunt_seeds or seed in record.seeds)
            for record in self.records
        )  # fmt: skip


def held_out_traffics(settings: HuntSettings, hunts: Iterable[Path]) -> HeldOutTraffics:
    """Return the rule by which hunts with common traffic are compared, and by which the trials of a rate count.

    Args:
        settings: settings of one of the hunts; all have the same seed.
        hunts: their directories; one for the rate of a single hunt.

    Raises:
        HuntDirectoryError: a record is damaged.
    """
    # Earlier snapshots count as well: after a change of the agent, a resumed hunt has trials of both agents.
    snapshots = [Snapshot(path) for hunt in hunts for path in sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN))]
    records = dict.fromkeys(record for snapshot in snapshots for record in _records_of(snapshot))
    return HeldOutTraffics(settings.seed, tuple(records))


def _records_of(snapshot: Snapshot) -> list[TrainedOn]:
    """Return the records in a snapshot.

    A list of hunts asks all of their snapshots. To check a whole manifest takes 4 ms, and few manifests name a record.
    """
    with suppress(OSError, ValueError):
        text = (snapshot.path / layout.MANIFEST).read_bytes()
        if layout.TRAINED_ON.encode() not in text and parse_object(text, dict):
            return []
    names = snapshot.manifest["argument_files"].values()
    return [read_trained_on(snapshot.path / name) for name in names if name.endswith(f"-{layout.TRAINED_ON}")]
