"""Crash bundles: the folder that holds everything needed to replay one crash."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from crashhunt._names import listed, near_path, one_of
from crashhunt.environment import versions
from crashhunt.errors import BundleError
from crashhunt.events import Event
from crashhunt.executors import BLACK_BOX, OUTPUT
from crashhunt.recording import Recording, foxglove_layout, read_black_box, read_log, write_log
from crashhunt.trial import ClosestApproach, Collision, Escape, Failure, Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.scene import Lane

__all__ = ["Bundle", "find_bundle", "list_bundles", "read_bundle", "write_bundle", "write_trial"]

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class Bundle:
    """A crash on disk.

    Args:
        path: of its folder.
        result: the crash.
        hunt_seed: of the hunt that found it.
        snapshot: the digest of the code that it ran.
        confirmed: whether a fresh process did the same to the bit; None where nobody tried.
        divergence: where it did not.
    """

    path: Path
    result: TrialResult
    hunt_seed: int
    snapshot: str
    confirmed: bool | None = None
    divergence: dict[str, Any] | None = None

    @property
    def id(self) -> str:
        """Its name within the hunt, such as ``000012-collision``."""
        return self.path.name

    @property
    def hunt(self) -> Path:
        """The hunt's directory."""
        return self.path.parent.parent

    @property
    def driver(self) -> str:
        """The agent that it is about; of one that is about none, the first."""
        result = self.result
        about = next((found.agent for found in (result.collision, result.event, result.failure) if found), "")
        return about or next(iter(self.result.spec.arguments), "")

    def recording(self) -> Recording:
        """Read the log.

        Raises:
            BundleError: it is missing or damaged.
        """
        return read_log(self.path / "log.mcap")

    def summary(self) -> dict[str, Any]:
        """Return the shape that ``run --json`` prints."""
        result = self.result
        return {
            "id": self.id,
            "trial": result.spec.number,
            "seed": result.spec.seed,
            "outcome": str(result.outcome),
            "step": result.steps,
            "arguments": {agent: dict(values) for agent, values in result.spec.arguments.items()},
            "scenario_arguments": dict(result.spec.scenario_arguments),
            "path": str(self.path),
            "digest": result.digest,
            "confirmed": self.confirmed,
        }

    def write(self, into: Path | None = None) -> None:
        """Write ``crash.json``, all of it or nothing; into another folder where the bundle is still being built."""
        folder = into or self.path
        result = self.result
        data = {
            "schema": SCHEMA,
            "id": self.id,
            "hunt_seed": self.hunt_seed,
            "trial": result.spec.number,
            "seed": result.spec.seed,
            "max_steps": result.spec.max_steps,
            "arguments": {agent: dict(values) for agent, values in result.spec.arguments.items()},
            "scenario_arguments": dict(result.spec.scenario_arguments),
            "outcome": str(result.outcome),
            "category": result.outcome.category,
            "summary": result.summary,
            "step": result.steps,
            "sim_time_s": result.sim_time_s,
            "collision": result.to_json()["collision"],
            "failure": result.to_json()["failure"],
            "escape": result.to_json()["escape"],
            "event": result.to_json()["event"],
            "events": result.to_json()["events"],
            "closest_approach": result.closest.to_json(),
            "digest": result.digest,
            "snapshot": self.snapshot,
            "versions": versions(),
            "confirmed": self.confirmed,
            "divergence": self.divergence,
        }
        temporary = folder / ".crash.json.part"
        temporary.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        os.replace(temporary, folder / "crash.json")  # noqa: PTH105 - one rename


def read_bundle(path: Path) -> Bundle:
    """Read a crash bundle.

    Raises:
        BundleError: it is not one, or it is damaged.
    """
    file = path / "crash.json"
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        if data["schema"] != SCHEMA:
            raise BundleError(
                f"schema {data['schema']!r} is not {SCHEMA}", fix="use the version that wrote it", where=str(file)
            )
        hit, failure, event, escape = data["collision"], data["failure"], data.get("event"), data.get("escape")
        result = TrialResult(
            TrialSpec(
                data["trial"], data["seed"], data["arguments"], data["scenario_arguments"], max_steps=data["max_steps"]
            ),
            Outcome(data["outcome"]),
            steps=data["step"],
            sim_time_s=data["sim_time_s"],
            digest=data["digest"],
            closest=ClosestApproach.from_json(data["closest_approach"]),
            collision=Collision.from_json(hit) if hit else None,
            failure=Failure(**failure) if failure else None,
            escape=Escape(**escape) if escape else None,
            event=Event.from_json(event) if event else None,
            events=data.get("events"),
        )
        return Bundle(path, result, data["hunt_seed"], data["snapshot"], data["confirmed"], data["divergence"])
    except OSError as error:
        raise BundleError(
            f"no crash bundle here: {error.strerror}", fix="give another folder", where=str(file)
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        message = f"not a crash.json: {type(error).__name__}: {error}"
        raise BundleError(message, fix="get an undamaged copy", where=str(file)) from None


def list_bundles(directory: Path) -> list[Bundle]:
    """Return the crashes of a hunt, in order of their trials."""
    return [read_bundle(path.parent) for path in sorted((directory / "crashes").glob("*/crash.json"))]


def find_bundle(directory: Path, crash: str = "") -> Bundle:
    """Return one crash of a hunt: the one that is named, or the one with the fewest steps.

    Args:
        directory: of the hunt, or of the bundle itself.
        crash: its id, the beginning of it, or its trial's number, with leading zeros or without.

    Raises:
        BundleError: there is no such crash.
    """
    if (directory / "crash.json").is_file() and not crash:
        return read_bundle(directory)
    bundles = list_bundles(directory)
    if not bundles:
        if not directory.is_dir():
            fix = f"{near_path(directory, '.zip')}give the directory of a hunt"
            raise BundleError(f"{str(directory)!r} does not exist", fix=fix)
        raise BundleError(
            "no crash was saved here", fix="give the directory of a hunt that found one", where=str(directory)
        )
    if not crash:
        return min(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
    return _named(bundles, crash, directory)


def _named(bundles: Sequence[Bundle], crash: str, directory: Path) -> Bundle:
    """The one crash that somebody can mean; an id is exact, and else a number, before the beginning of an id."""
    number = int(crash) if crash.isdecimal() else None
    for meant in (
        [bundle for bundle in bundles if bundle.id == crash],
        [bundle for bundle in bundles if bundle.result.spec.number == number],
        [bundle for bundle in bundles if bundle.id.startswith(crash)],
    ):
        if len(meant) == 1:
            return meant[0]
        if meant:
            fix = f"give one of {listed(bundle.id for bundle in meant)}"
            raise BundleError(f"{crash!r} may be several crashes", fix=fix, where=str(directory))
    fix = one_of(crash, (bundle.id for bundle in bundles))
    raise BundleError(f"there is no crash {crash!r}", fix=fix, where=str(directory))


def write_bundle(
    directory: Path, result: TrialResult, scratch: Path, *, hunt_seed: int, snapshot: str, lanes: Sequence[Lane]
) -> Bundle:
    """Make the bundle of a crash from what its trial left behind.

    Args:
        directory: of the hunt.
        result: the crash.
        scratch: the trial's scratch folder; it is emptied.
        hunt_seed: of the hunt.
        snapshot: the digest of the code that ran.
        lanes: of the map, for whoever looks at the log.
    """
    name = f"{result.spec.number:06d}-{result.outcome}"
    final, building = directory / "crashes" / name, directory / "crashes" / f".{name}.part"
    shutil.rmtree(building, ignore_errors=True)
    building.mkdir(parents=True)
    recording = Recording(read_black_box(scratch / BLACK_BOX))
    metadata = {"trial": str(result.spec.number), "seed": str(result.spec.seed), "outcome": str(result.outcome)}
    write_log(building / "log.mcap", recording, lanes=lanes, metadata=metadata, crash=result)
    layout = json.dumps(foxglove_layout(recording), indent=1)
    (building / "foxglove-layout.json").write_text(layout, encoding="utf-8")
    _collect_output(result, scratch, building)
    bundle = Bundle(final, result, hunt_seed, snapshot)
    bundle.write(into=building)
    shutil.rmtree(final, ignore_errors=True)
    building.rename(final)
    shutil.rmtree(scratch, ignore_errors=True)
    return bundle


def write_trial(directory: Path, result: TrialResult, scratch: Path) -> None:
    """Keep what a trial printed that is no crash; its scratch folder is emptied."""
    target = directory / "trials" / f"{result.spec.number:06d}"
    target.mkdir(parents=True, exist_ok=True)
    params = json.dumps(result.to_json(), indent=2)
    (target / "params.json").write_text(params, encoding="utf-8")
    _collect_output(result, scratch, target)
    shutil.rmtree(scratch, ignore_errors=True)


def _collect_output(result: TrialResult, scratch: Path, target: Path) -> None:
    run_log = scratch / OUTPUT
    if run_log.is_file():
        shutil.copyfile(run_log, target / "run.log")
    failure = result.failure
    if failure is not None:
        parts = (f"{failure.kind}: {failure.message}", failure.traceback, failure.last_output)
        text = "\n\n".join(part.rstrip() for part in parts if part.strip())
        (target / "error.log").write_text(text + "\n", encoding="utf-8", errors="replace")
