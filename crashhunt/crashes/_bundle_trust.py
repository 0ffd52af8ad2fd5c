"""Decide whether the code of a crash may run: code made here, trusted code, or code of this repository."""

from __future__ import annotations

import hashlib
import json
import os
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import CrashhuntError, HuntDirectoryError, UntrustedError, UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.git import git_directory, tracked_files, work_tree
from crashhunt.base.integrity import authentication_code, is_authentic, parse_object, state_folders
from crashhunt.base.plugins import Group, registered
from crashhunt.base.text import command_line
from crashhunt.crashes._bundle import Bundle, snapshot_of
from crashhunt.oracles import oracle_name
from crashhunt.plans import read_settings, with_settings
from crashhunt.scenario import backend_of
from crashhunt.trial import Choice, Constant, is_stored_signal

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario
    from crashhunt.snapshots import Snapshot
    from crashhunt.trial import Distribution, TrialSpec, Value


# What this user trusts although it was not made here: a file for each origin in the folder of the user's state.

_TRUST_FOLDER = "trusted"
_FINGERPRINT_CHARACTERS = 12  # characters of a fingerprint
_MIN_FINGERPRINT_CHARACTERS = 6  # characters of a fingerprint that name an origin


@dataclass(frozen=True, slots=True)
class TrustedOrigin(Serializable):
    """Code that this user has decided to trust."""

    fingerprint: str  # SHA-256 of everything that determines the code that would run, in hexadecimal
    path: str  # path of the code when the user trusted it
    runs: str  # a description of what would run, in words
    trusted_at: str  # time (UTC) at which the user trusted the code

    @property
    def id(self) -> str:
        """The beginning of the fingerprint, which identifies the trusted code."""
        return self.fingerprint[:_FINGERPRINT_CHARACTERS]


def add_trusted(fingerprint: str, *, path: str, runs: str) -> TrustedOrigin:
    """Mark code as trusted from now on, and return the new entry.

    ``runs`` describes in words what would run.

    Raises:
        HuntDirectoryError: the entry cannot be stored in any folder.
    """
    now = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    origin = TrustedOrigin(fingerprint=fingerprint, path=path, runs=runs, trusted_at=now)
    error: Exception | None = None
    for folder in _folders():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with whole_file(folder / f"{fingerprint}.json") as temporary:
                temporary.write_text(json.dumps({"schema": 1, **asdict(origin)}, indent=1), encoding="utf-8")
        except (OSError, HuntDirectoryError) as failed:
            error = failed
            continue
        return origin
    raise HuntDirectoryError(
        f"the list of trusted origins cannot be saved: {error}",
        fix="set XDG_STATE_HOME to a folder that can be written",
    )


def list_trusted() -> list[TrustedOrigin]:
    """Return all code that this user trusts, the oldest entry first."""
    names = {field.name for field in fields(TrustedOrigin)}
    found: dict[str, TrustedOrigin] = {}
    for folder in _folders():
        for file in folder.glob("*.json"):
            with suppress(OSError, ValueError, TypeError):  # a file that is damaged trusts nothing
                data = parse_object(file.read_bytes(), dict)
                origin = TrustedOrigin(**{name: str(value) for name, value in data.items() if name in names})
                if file.stem == origin.fingerprint:
                    found.setdefault(origin.fingerprint, origin)
    return sorted(found.values(), key=lambda origin: (origin.trusted_at, origin.fingerprint))


def is_fingerprint_trusted(fingerprint: str) -> bool:
    """Return whether this user trusts the code with a fingerprint."""
    return any((folder / f"{fingerprint}.json").is_file() for folder in _folders())


def remove_trusted(names: Sequence[str]) -> list[TrustedOrigin]:
    """Remove entries from the trusted code, and return the removed entries.

    Args:
        names: for each entry, the beginning of its fingerprint, or the path at which the code was trusted.

    Raises:
        UsageError: a name matches no entry, or several entries; then no entry is removed.
        HuntDirectoryError: an entry cannot be removed.
    """
    known = list_trusted()
    chosen: dict[str, TrustedOrigin] = {}
    for name in names:
        place = str(Path(name).resolve())
        found = [origin for origin in known if place == origin.path]
        if not found and len(name) >= _MIN_FINGERPRINT_CHARACTERS:
            found = [origin for origin in known if origin.fingerprint.startswith(name.lower())]
            if len(found) > 1:
                raise UsageError(
                    f"--remove {name!r} matches {len(found)} origins", fix="give more characters of the fingerprint"
                )
        if not found:
            raise UsageError(
                f"--remove {name!r}: no trusted origin has this name", fix="crashhunt trust lists the trusted origins"
            )
        chosen |= {origin.fingerprint: origin for origin in found}
    for fingerprint in chosen:
        for folder in _folders():
            try:
                (folder / f"{fingerprint}.json").unlink(missing_ok=True)
            except OSError as error:
                raise HuntDirectoryError(
                    f"cannot be removed: {error.strerror or error}", fix="make the folder writable", where=str(folder)
                ) from error
    return list(chosen.values())


def _folders() -> list[Path]:
    return [folder / _TRUST_FOLDER for folder in state_folders()]


# Who made a bundle: an authentication code shows that this user made it on this machine.

_PURPOSE = "crash bundle"


def authenticate_bundle(bundle: Bundle) -> str:
    """Return the authentication code of a bundle that this process writes; empty if its snapshot is not this user's.

    Without this condition, a crash that was minimized or confirmed in another person's hunt would count as made here.
    """
    try:
        made_here = snapshot_of(bundle).is_made_here
    except CrashhuntError:  # there is none, as of a candidate of a minimization
        return ""
    return authentication_code(_PURPOSE, _statement(bundle)) if made_here else ""


def is_bundle_made_here(bundle: Bundle) -> bool:
    """Return whether this user made a bundle and its snapshot on this machine. The files of the snapshot are not read.

    Raises:
        BundleError: the manifest of the snapshot is missing or damaged.
    """
    return snapshot_of(bundle).is_made_here and is_authentic(_PURPOSE, _statement(bundle), bundle.authentication_code)


def _statement(bundle: Bundle) -> dict[str, object]:
    """Return everything in a bundle that determines what runs, and the recording's digest, as text to authenticate."""
    spec = bundle.result.spec.to_json()
    return {
        **{name: spec[name] for name in ("number", "seed", "max_steps", "arguments", "scenario_arguments")},
        "disturbances": spec.get("disturbances") or [],
        "only": spec.get("only"),
        "script": spec.get("script"),
        "digest": bundle.result.digest,
        "snapshot": bundle.snapshot,
    }


# Whether the code of a crash, a snapshot or a hunt may run.


def is_bundle_trusted(bundle: Bundle, *, faults: Sequence[str] | None = None) -> bool:
    """Return whether the code of a crash may run without a confirmation by the user."""
    try:
        snapshot = snapshot_of(bundle)
        settings = read_settings(bundle.hunt / layout.HUNT)
        if snapshot.faults() if faults is None else faults:
            return False
        # The hunt's settings name the imports, but only the settings in the snapshot are authenticated.
        if not _unknown_names(settings, snapshot):
            if is_bundle_made_here(bundle):
                return True
            # The user has seen the texts that the settings name, such as files of weights, and no others.
            if is_fingerprint_trusted(snapshot.fingerprint()) and _has_known_texts(
                bundle.result.spec, settings, snapshot
            ):
                return True
    except CrashhuntError:  # what cannot be read cannot be known
        return False
    return _is_of_this_repository(_decisive(bundle, snapshot))


def is_snapshot_trusted(snapshot: Snapshot) -> bool:
    """Return whether the code of a snapshot may run without a confirmation by the user."""
    try:
        if snapshot.faults():
            return False
        return snapshot.is_made_here or is_fingerprint_trusted(snapshot.fingerprint())
    except CrashhuntError:
        return False


def is_hunt_trusted(hunt: Path, snapshot: Snapshot) -> bool:
    """Return whether the code that a hunt's settings name may run without a confirmation by the user."""
    try:
        settings = read_settings(hunt / layout.HUNT)
        same_scenario = settings.scenario == snapshot.settings.scenario
        if same_scenario and not _unknown_names(settings, snapshot) and is_snapshot_trusted(snapshot):
            return True
    except CrashhuntError:
        return False
    return _is_of_this_repository((hunt / layout.HUNT, snapshot.path / layout.MANIFEST))


def trust_snapshot(snapshot: Snapshot, path: Path) -> TrustedOrigin:
    """Mark the code of a snapshot as trusted from now on, and return the new entry.

    Raises:
        BundleError: the snapshot is damaged.
        HuntDirectoryError: the entry cannot be written.
    """
    snapshot.verify()
    runs = describe_code(snapshot, snapshot.settings)
    return add_trusted(snapshot.fingerprint(), path=str(path.resolve()), runs=runs)


def describe_code(snapshot: Snapshot, settings: HuntSettings) -> str:
    """Return a description of the code that would run: the agents and crashhunt, with their paths."""
    names = {agent.agent for agent in settings.agents.values()}
    names |= {oracle for oracle in settings.oracles if ":" in oracle}
    with suppress(CrashhuntError):  # a scenario that cannot be read runs nothing
        names |= set(snapshot.scenario.modules())
    agents = ", ".join(sorted(names)) or "no agent"
    if not snapshot.has_code:
        return f"{agents}, as installed here or found from the current folder, in the scenario of {snapshot.digest}"
    version = snapshot.environment.get("versions", {}).get("crashhunt", "of an unknown version")
    return f"{agents} and crashhunt {version}, both from the snapshot {snapshot.digest}"


def refuse_untrusted(bundle: Bundle, *, where: str = "", made_by: str = "") -> UntrustedError:
    """Return the error that refuses to run the code of a crash.

    ``where`` is the path that the user gave; by default the folder of the crash. ``made_by`` names the tool that made
    the file, according to the file itself.
    """
    place = where or str(bundle.path)
    fix = f"if you trust that code, run {command_line('crashhunt', 'trust', place)} once, or add --trust"
    snapshot = snapshot_of(bundle)
    changed = ""
    try:
        settings = read_settings(bundle.hunt / layout.HUNT)
        runs = f": {describe_code(snapshot, settings)}"
        changed = _first_change(settings, snapshot)
    except CrashhuntError as error:
        runs = f", which cannot be described: {error.message}"
    if changed:  # trust in the code as it was taken is no trust in the code as it is now
        proof, fix = changed, "get an undamaged copy, or add --trust if you trust that code as it is now"
        if made_by:
            proof = f"it says that {made_by} made it; {changed}"
    elif made_by:
        proof = f"it says that {made_by} made it"
    elif (top := _repository_of(_decisive(bundle, snapshot))) is not None:
        proof = f"it belongs to the repository {top}, of which you have run no code on this machine"
        fix = (
            f"if you trust all that git tracks there, run {command_line('crashhunt', 'trust', str(top))} once, or add "
        )
        fix += "--trust"
    elif bundle.authentication_code:
        proof = "you did not make it on this machine, or it has changed since"
    else:
        proof = "nothing proves that you made it on this machine"
    return UntrustedError(
        f"{proof}, and this would run its code{runs}",
        fix=f"{fix}; crashhunt replay --from-log runs none of it",
        where=place,
    )


def _first_change(settings: HuntSettings, snapshot: Snapshot) -> str:
    """Return the first difference between a bundle and its snapshot as text; empty if there is none."""
    faults = snapshot.faults()
    if faults:
        return f"the snapshot is damaged: {faults[0]}"
    names = _unknown_names(settings, snapshot)
    if names:
        return f"hunt.toml names {names[0]!r}, which it did not name when the snapshot was taken"
    if is_fingerprint_trusted(snapshot.fingerprint()):
        return "its arguments name texts that its hunt does not name"
    return ""


def _has_known_texts(spec: TrialSpec, settings: HuntSettings, snapshot: Snapshot) -> bool:
    """Return whether all texts among a trial's arguments also occur in its hunt's settings or in its scenario."""
    scenario = with_settings(snapshot.scenario, settings)
    arguments = [*scenario.scenario_arguments().values()]
    for agent in scenario.agents:
        arguments += scenario.agent_arguments(agent).values()
    known = _texts([*settings.space.values(), *(argument.distribution for argument in arguments)])
    known |= {argument.default for argument in arguments if isinstance(argument.default, str)}
    values = [*spec.scenario_arguments.values(), *(one for each in spec.arguments.values() for one in each.values())]
    return all(value in known or is_stored_signal(value) for value in values if isinstance(value, str))


def _unknown_names(settings: HuntSettings, snapshot: Snapshot) -> list[str]:
    """Return the names in the settings that could be imported or opened, and that the snapshot's settings lack.

    Numbers may differ, so that the user can change them and replay the crash.
    """
    known = snapshot.settings
    agents = {agent.agent for agent in known.agents.values()}
    found = [agent.agent for agent in settings.agents.values() if agent.agent not in agents]
    plugins: tuple[tuple[Group, str, str, tuple[str, ...]], ...] = (
        *(("oracles", oracle_name(text), text, known.oracles) for text in settings.oracles),
        ("samplers", settings.sampler, settings.sampler, (known.sampler,)),
        ("executors", settings.run.executor.partition(":")[0], settings.run.executor, (known.run.executor,)),
    )
    found += [text for group, name, text, before in plugins if text not in before and name not in registered(group)]
    return found + sorted(_texts(settings.space.values()) - _texts(known.space.values()))


def _texts(distributions: Iterable[Distribution | None]) -> set[str]:
    """Return the texts, such as names of files, among the values of arguments."""
    values: list[object] = []
    for distribution in distributions:
        if isinstance(distribution, Constant):
            values.append(distribution.value)
        elif isinstance(distribution, Choice):
            values += distribution.options
    return {value for value in values if isinstance(value, str)}


def _decisive(bundle: Bundle, snapshot: Snapshot) -> tuple[Path, ...]:
    return bundle.path / layout.CRASH, bundle.hunt / layout.HUNT, snapshot.path / layout.MANIFEST


def _is_of_this_repository(files: Iterable[Path]) -> bool:
    """Return whether files belong to the project in which the user works, whose tests could run the same code anyway.

    Such files are tracked by git in the work tree of the current folder, which this user has trusted: anybody can put a
    ``.git`` into a folder. A CI job trusts its work tree, or its current folder if there is none, as in a container
    without ``.git``.
    """
    here, is_ci = Path(os.path.realpath(os.curdir)), bool(os.environ.get("CI"))
    if is_ci and work_tree(here) is None:
        return all(Path(os.path.realpath(file)).is_relative_to(here) for file in files)
    top = _repository_of(files)
    return top is not None and (is_ci or is_fingerprint_trusted(_fingerprint_of_repository(top)))


def _repository_of(files: Iterable[Path]) -> Path | None:
    """Return the work tree of the current folder if git tracks all files in it; else None."""
    top = work_tree(Path(os.path.realpath(os.curdir)))
    resolved = [Path(os.path.realpath(file)) for file in files]
    if top is None or not all(file.is_relative_to(top) for file in resolved):
        return None
    tracked = tracked_files(top)
    return top if all(file.relative_to(top).as_posix() in tracked for file in resolved) else None


def trust_repository(top: Path) -> TrustedOrigin:
    """Trust the files that git tracks in a work tree, in their present and later states, and return the new entry.

    Symbolic links in ``top`` must have been resolved.

    Raises:
        HuntDirectoryError: the entry cannot be stored in any folder.
    """
    return add_trusted(_fingerprint_of_repository(top), path=str(top), runs="all that git tracks there")


def trust_repositories(tops: Iterable[str]) -> None:
    """Trust the work trees whose code this user runs in a hunt."""
    for top in map(Path, tops):
        with suppress(HuntDirectoryError):  # a user without a state is asked in each command
            if not is_fingerprint_trusted(_fingerprint_of_repository(top)):
                trust_repository(top)


def _fingerprint_of_repository(top: Path) -> str:
    """Return the fingerprint of a work tree, which consists of paths, and not of anything that lies in the work tree.

    A repository may claim the work tree of another one (``core.worktree``), and a work tree the repository of another
    one (a file ``.git``).
    """
    return hashlib.sha256(f"repository\0{top}\0{git_directory(top)}".encode("utf-8", "surrogateescape")).hexdigest()


# What a stranger's crash may make this process do when its recorded actions are driven: simulate, and nothing else.


def refuse_side_effects(scenario: Scenario, settings: HuntSettings, values: Mapping[str, Value]) -> None:
    """Refuse a scenario that has side effects, or whose side effects are unknown.

    Raises:
        UsageError: the scenario has side effects; the message names the side effects.
    """
    names: list[tuple[Group, str]] = [("simulators", scenario.simulator)]
    names += [("oracles", oracle_name(text)) for text in settings.oracles]
    for group, name in names:
        if name not in registered(group):
            raise _refusal(f"the configuration of the scenario imports the module {name!r}")
    for module in scenario.modules():
        raise _refusal(f"the configuration of the scenario imports the module {module!r}")
    backend = backend_of(scenario.simulator)
    if backend is None or backend.side_effect is None:
        raise _refusal(f"the side effects of the simulator {scenario.simulator!r} are unknown")
    asked = [spec.spec for spec in settings.scenario_arguments.values() if spec.kind == "str"]
    effect = backend.side_effect(scenario, values, asked)
    if effect:
        raise _refusal(effect)


def _refusal(reason: str) -> UsageError:
    return UsageError(
        f"the crash was not made on this machine, and {reason}", fix="give --trust if you trust its author"
    )
