"""The split of traffic seeds into a training part and a test part, by a hash of the seed.

The seed of a trial determines its traffic. Only the hash decides. Every hunt, machine and process therefore assigns a
seed to the same part, whether its trial crashed or not. Agents can therefore be compared on the whole test part without
bias. If only crashes were split, agents would be compared on traffic that was selected by its outcome.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.text import near_path
from crashhunt.crashes import Bundle, list_bundles, read_bundle
from crashhunt.plans import read_settings

if TYPE_CHECKING:
    from collections.abc import Iterable

_HASH_BYTES = 8


def is_test_traffic(seed: int, test: float) -> bool:
    """Return whether the traffic of a seed belongs to the test part.

    The first 64 bits of BLAKE2b of the seed in decimal digits, divided by 2**64, are compared with the share. A larger
    share adds traffics to the test part and removes none.

    Args:
        seed: seed of the trial.
        test: share of the traffic seeds in the test part, from 0 to 1.
    """
    digest = hashlib.blake2b(str(seed).encode(), digest_size=_HASH_BYTES).digest()
    return bool(int.from_bytes(digest) < test * 2 ** (8 * _HASH_BYTES))


def check_test_share(test: float, shown: str) -> float:
    """Return the share of the test part after checking it.

    Args:
        test: the share.
        shown: name of the share in error messages.

    Raises:
        UsageError: the share is not from 0 to below 1.
    """
    if not 0 <= test < 1:  # also refuses NaN
        raise UsageError(f"{shown} is {test:g}", fix="give a share from 0 to below 1, such as 0.5")
    return test


@dataclass(frozen=True, slots=True)
class SavedCrash(Serializable):
    """A saved crash, for training or for tests.

    Args:
        bundle: bundle of the crash.
        is_test: whether the traffic seed of the crash belongs to the test part.
    """

    bundle: Bundle
    is_test: bool

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
    """Saved crashes, split into a training part and a test part.

    Args:
        test: share of the traffic seeds in the test part.
        crashes: all crashes, in the order of the given directories and of their trials.
        faults: number of omitted software faults, which an agent cannot learn to avoid by driving.
    """

    test: float
    crashes: tuple[SavedCrash, ...]
    faults: int = 0

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

    Args:
        places: directories of hunts, of corpora, of corpus cases or of bundles.
        test: share of the traffic seeds in the test part.

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
