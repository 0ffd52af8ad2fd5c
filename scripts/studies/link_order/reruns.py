"""Hunts in SUMO configurations, and runs each trial again in a new Python process, which must give the same digest.

Where a digest differs, the first different step and field are printed. A hunt that is in ``--out`` already is resumed.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
from collections import Counter
from contextlib import closing
from pathlib import Path
from xml.etree import ElementTree as ET

from heap_orders import build_allocator

from crashhunt.base import layout
from crashhunt.hunts._hunt_setup import settings_again
from crashhunt.ledger import Ledger
from crashhunt.recording import first_divergence
from crashhunt.snapshots import Snapshot
from crashhunt.trial_reruns import SharedReruns, run_alone


def main() -> bool:
    """Print a row for each configuration; return whether a trial differs or a hunt fails."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("paths", nargs="+", type=Path, metavar="PATH", help=".sumocfg file, or folder with such files")
    parser.add_argument("--trials", type=int, default=12, help="trials per configuration (default: 12)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of simulation per trial (default: 60)")
    parser.add_argument("--step-lengths", nargs="+", type=float, metavar="S", help="in s, each with its own hunt")
    parser.add_argument("--out", type=Path, default=Path("reruns"), help="folder for the hunts (default: reruns)")
    parser.add_argument(
        "--permute", action="store_true", help="run again with another order of addresses in each trial"
    )
    words = [*sys.argv[1:], "--"]
    given, options = parser.parse_args(words[: words.index("--")]), words[words.index("--") + 1 : -1]
    given.out.mkdir(parents=True, exist_ok=True)
    failed = False
    print("| configuration | step length, s | outcomes | run again | different |\n| --- | --- | --- | --- | --- |")
    configs = {file for path in given.paths for file in ([path] if path.is_file() else path.rglob("*.sumocfg"))}
    for config, wanted_s in itertools.product(sorted(configs), given.step_lengths or [None]):
        hunt = given.out / f"{config.parent.name}-{config.stem}"
        if wanted_s is not None:
            hunt = hunt.with_name(f"{hunt.name}-{wanted_s:g}s")
            config = _write_configuration(config, wanted_s, hunt.with_name(f"{hunt.name}.sumocfg"))
        found = ET.parse(config).find(".//step-length")
        step_length_s = float(found.get("value", "1")) if found is not None else 1.0
        command = [sys.executable, "-m", "crashhunt", "run", str(hunt), "1", str(given.trials)]
        command += [str(round(given.seconds / step_length_s)), "--scenario", str(config), "--seed", "1", "--keep-going"]
        done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
        hunt.with_name(f"{hunt.name}.txt").write_text(done.stdout + done.stderr)
        if done.returncode:
            failed |= done.returncode != 3  # no trial is valid, as where no vehicle enters
            print(f"| {hunt.name} | {step_length_s:g} | {(done.stderr.splitlines() or ['?'])[-1]} | 0 | |", flush=True)
            continue
        outcomes, again, different = _run_again(hunt, permute=given.permute)
        counts = ", ".join(f"{name} {count}" for name, count in sorted(outcomes.items()))
        row = f"| {hunt.name} | {step_length_s:g} | {counts} | {again} | {len(different)} |"
        print("\n".join((row, *different)), flush=True)
        failed |= bool(different)
    return failed


def _write_configuration(config: Path, step_length_s: float, to: Path) -> Path:
    """Write a copy of a configuration that has another step length and absolute paths; return its path."""
    tree = ET.parse(config)
    for element in tree.iter():
        files = [config.parent.resolve() / name.strip() for name in element.get("value", "").split(",")]
        if all(file.is_file() for file in files):
            element.set("value", ",".join(map(str, files)))
    for parent in tree.iter():
        for element in parent.findall("step-length"):
            parent.remove(element)
    ET.SubElement(ET.SubElement(tree.getroot(), "time"), "step-length", value=f"{step_length_s:g}")
    tree.write(to)
    return to


def _run_again(hunt: Path, *, permute: bool) -> tuple[Counter[str], int, list[str]]:
    """Return the outcomes of a hunt, how many of its trials ran again, and a line for each that is different."""
    with closing(Ledger(hunt / layout.LEDGER)) as ledger:
        results = [(result, ledger.snapshot_of(result.spec.number)) for result in ledger.results()]
    wanted = [(result, digest) for result, digest in results if result.digest]  # a trial that was not set up has none
    different = []
    for was, digest in wanted:
        snapshot, number = Snapshot(hunt / layout.SNAPSHOTS / digest), was.spec.number
        with tempfile.TemporaryDirectory() as folder:
            settings = settings_again(snapshot.settings, snapshot, Path(folder))
            if permute:  # the new process loads the allocator, this one does not
                os.environ |= {"LD_PRELOAD": str(build_allocator(Path(folder))), "HEAP_ORDER": str(number + 1)}
            (alone,) = run_alone(settings, was.spec)
            now = alone.result
            os.environ.pop("LD_PRELOAD", None)
            if (now.outcome, now.steps, now.digest) == (was.outcome, was.steps, was.digest):
                continue
            with closing(SharedReruns(Path(folder), parallel=1)) as shared:
                forked = shared.run(settings, was.spec)
            assert forked.recording is not None
            assert alone.recording is not None
            found = first_divergence(forked.recording, alone.recording)
            runs = ", ".join(f"{run.outcome} at step {run.steps} ({run.digest})" for run in (was, now, forked.result))
            different.append(
                f"trial {number} of {hunt}: hunt, new process, fork again: {runs}; {found or 'the last two are equal'}"
            )
    return Counter(str(result.outcome) for result, _ in results), len(wanted), different


if __name__ == "__main__":
    sys.exit(main())
