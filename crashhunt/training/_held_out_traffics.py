"""Held-out traffics: the split of traffic seeds into a training and a test part, and the seeds of a policy's training.

The seed of a trial determines its traffic. Only a hash of the seed decides. Every hunt, machine and process therefore
assigns a seed to the same part, whether its trial crashed or not. Agents can therefore be compared on the whole test
part without bias. If only crashes were split, agents would be compared on traffic that was selected by its outcome.

``trained_on.json`` lists the traffic seeds on which a policy was trained. The file lies next to the policy and is part
of snapshots. A comparison on these traffic seeds shows only what the policy has memorized. `held_out_traffics` returns
the rule by which `crashhunt compare`, `gate` and `rate` keep only the traffic seeds of the test part, regardless of
their outcome.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, HuntDirectoryError, UsageError
from crashhunt.base.files import locked_folder, whole_file
from crashhunt.base.integrity import parse_object, read_bounded, typed
from crashhunt.base.text import near_path
from crashhunt.crashes import Bundle, list_bundles, read_bundle
from crashhunt.plans import read_settings
from crashhunt.snapshots import Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.plans import HuntSettings

# The split of traffic seeds.

_HASH_BYTES = 8


def is_test_traffic(seed: int, test: float) -> bool:
    """Return whether the traffic of a seed belongs to the test part.

    The first 64 bits of BLAKE2b of the seed in decimal digits, divided by 2**64, are compared with the share. A larger
    share adds traffics to the test part and removes none.
    """
    digest = hashlib.blake2b(str(seed).encode(), digest_size=_HASH_BYTES).digest()
    return bool(int.from_bytes(digest) < test * 2 ** (8 * _HASH_BYTES))


def check_test_share(test: float, shown: str) -> float:
    """Return the share of the test part after checking it.

    Raises:
        UsageError: the share is not from 0 to below 1.
    """
    if not 0 <= test < 1:  # also refuses NaN
        raise UsageError(f"{shown} is {test:g}", fix="give a share from 0 to below 1, such as 0.5")
    return test


@dataclass(frozen=True, slots=True)
class SavedCrash(Serializable):
    """A saved crash, for training or for tests."""

    bundle: Bundle  # bundle of the crash
    is_test: bool  # whether the traffic seed of the crash belongs to the test part

    json_keys = ("id=bundle.id", "hunt=bundle.hunt", "path=bundle.path", "seed")

    @property
    def seed(self) -> int:
        """Seed of the crash's trial."""
        return self.bundle.result.spec.seed

    @property
    def name(self) -> str:
        """Name of the crash, which is unique among hunts with different directories."""
        return f"{self.bundle.hunt.name}/{self.bundle.id}"


@dataclass(frozen=True, slots=True)
class Split(Serializable):
    """Saved crashes, split into a training part and a test part."""

    test: float  # share of the traffic seeds in the test part
    crashes: tuple[SavedCrash, ...]  # all crashes, in the order of the given directories and of their trials
    faults: int = 0  # number of omitted software faults, which an agent cannot learn to avoid by driving

    json_keys = ("test", "training", "held_out", "software_faults=faults")

    @property
    def training(self) -> tuple[SavedCrash, ...]:
        """The crashes of the training part."""
        return tuple(crash for crash in self.crashes if not crash.is_test)

    @property
    def held_out(self) -> tuple[SavedCrash, ...]:
        """The crashes of the test part."""
        return tuple(crash for crash in self.crashes if crash.is_test)


def split_crashes(places: Iterable[Path | str], test: float) -> Split:
    """Return the crashes of hunts, corpora or single bundles, each with its part.

    The places are directories of hunts, of corpora, of corpus cases or of bundles.

    Raises:
        BundleError: a directory contains no crash, or a crash is damaged.
    """
    found: dict[Path, Bundle] = {}
    for place in map(Path, places):
        bundles = _bundles_of(place)
        if not bundles:
            raise BundleError(
                "no crash was saved here", fix="give the directory of a hunt or a corpus with crashes", where=str(place)
            )
        found.update((bundle.path.resolve(), bundle) for bundle in bundles)
    driving = [bundle for bundle in found.values() if not bundle.result.outcome.is_software_fault]
    crashes = tuple(SavedCrash(bundle, is_test_traffic(bundle.result.spec.seed, test)) for bundle in driving)
    return Split(test, crashes, faults=len(found) - len(driving))


def _bundles_of(place: Path) -> list[Bundle]:
    if not place.is_dir():
        fix = f"{near_path(place)}give the directory of a hunt, a corpus or a crash"
        raise BundleError(f"{str(place)!r} is not a directory", fix=fix)
    if (place / layout.CRASH).is_file():
        return [read_bundle(place)]
    if (place / layout.HUNT).is_file():
        read_settings(place / layout.HUNT)  # names what is wrong with a damaged hunt
        return list_bundles(place)
    cases = sorted(path.parent for path in place.glob(f"*/{layout.CASE}"))
    return [bundle for case in cases for bundle in list_bundles(case)]


# ``trained_on.json``.

_SCHEMA = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedOn:
    """The traffic seeds on which a policy was trained."""

    test: float  # share of the test part, which is never used for training
    seeds: frozenset[int] = frozenset()  # seeds of the crashes that were used for training
    # seeds of the hunts that found these crashes. Traffic seeds of these hunts without a crash are split as well.
    hunt_seeds: frozenset[int] = frozenset()

    def write(self, path: Path) -> None:
        """Write the file, or add to an existing file. Several processes may do this at the same time.

        Raises:
            UsageError: the existing file has another split.
            HuntDirectoryError: the file is damaged or cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # A lock of the folder leaves no further file next to the policy.
            with locked_folder(path.parent):
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


def read_trained_on(path: Path) -> TrainedOn:
    """Read ``trained_on.json``, and return its contents.

    Raises:
        HuntDirectoryError: the file is missing or damaged.
    """
    try:
        data: dict[str, Any] = parse_object(read_bounded(path), dict)
        typed(data, {"schema": int, "seeds": list[int], "hunt_seeds": list[int]})
        test = float(data["test"])
        if data["schema"] != _SCHEMA or not 0 <= test < 1:
            raise ValueError(f"schema is {data['schema']} and test is {test:g}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise HuntDirectoryError(
            f"cannot be read: {reason}",
            fix="restore the file: without it, the training traffics are unknown",
            where=str(path),
        ) from None
    return TrainedOn(test=test, seeds=frozenset(data["seeds"]), hunt_seeds=frozenset(data["hunt_seeds"]))


@dataclass(frozen=True, slots=True)
class HeldOutTraffics:
    """The traffic seeds of a hunt on which no agent of a comparison was trained."""

    hunt_seed: int
    records: tuple[TrainedOn, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether no traffic of the hunt is held out, because an agent was trained on the hunt without a test part."""
        return any(not record.test and self.hunt_seed in record.hunt_seeds for record in self.records)

    def has(self, seed: int) -> bool:
        """Return whether a comparison may use the traffic of a seed.

        If the hunt was used for training, only the hash of the seed decides. Excluding only the crashes used for
        training would keep training seeds without a crash, and would favour the version before the training.
        """
        return all(
            is_test_traffic(seed, record.test)
            or not (self.hunt_seed in record.hunt_seeds or seed in record.seeds)
            for record in self.records
        )  # fmt: skip


def held_out_traffics(settings: HuntSettings, hunts: Iterable[Path]) -> HeldOutTraffics:
    """Return the rule that selects the trials with held-out traffic, for comparisons of hunts and for crash rates.

    All hunts have the same seed; for the rate of a single hunt, there is one directory.

    Raises:
        HuntDirectoryError: a training record is damaged.
    """
    # Earlier snapshots count as well: after a change of the agent, a resumed hunt has trials of both agents.
    snapshots = [Snapshot(path) for hunt in hunts for path in sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN))]
    records = dict.fromkeys(record for snapshot in snapshots for record in _records_of(snapshot))
    return HeldOutTraffics(settings.seed, tuple(records))


def _records_of(snapshot: Snapshot) -> list[TrainedOn]:
    """Return the training records in a snapshot.

    Lists of hunts call this function for all snapshots. Checking a whole manifest takes 4 ms, and few manifests contain
    a record.
    """
    with suppress(OSError, ValueError):
        text = read_bounded(snapshot.path / layout.MANIFEST)
        if layout.TRAINED_ON.encode() not in text and parse_object(text, dict):
            return []
    names = snapshot.manifest["argument_files"].values()
    return [read_trained_on(snapshot.path / name) for name in names if name.endswith(f"-{layout.TRAINED_ON}")]
