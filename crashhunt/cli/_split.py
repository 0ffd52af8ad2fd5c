"""``crashhunt split``."""

from __future__ import annotations

from pathlib import Path

from crashhunt.cli._common import DONE, CommandOptions, Commands, add_json

_PARTS = ("training", "test")


def add_split(commands: Commands) -> None:
    """Add the command ``split`` to the parser."""
    split = commands.add_parser(
        "split",
        help="divide crashes into a training and a test part",
        description="Divide the crashes of hunts and corpora into a training part and a test part, by a hash of the "
        "seed of each traffic. The environment crashhunt/Crashes-v0 trains on the training part only, and compare and "
        "gate count only the test part.",
    )
    split.add_argument("places", metavar="DIR", type=Path, nargs="+", help="folders of hunts, corpora or crashes")
    split.add_argument(
        "--test",
        metavar="SHARE",
        type=float,
        default=0.5,
        help="share of the traffics that belong to the test part (default: %(default)s)",
    )
    split.add_argument(
        "--part", choices=_PARTS, help="print only the folders of the crashes in this part, one in each line"
    )
    add_json(split)
    split.set_defaults(command=_split)


def _split(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.training import check_test_share, split_crashes

    found = split_crashes(options.places, check_test_share(options.test, "--test"))
    parts = {"training": found.training, "test": found.held_out}
    if options.part is not None:
        lines = [str(crash.bundle.path) for crash in parts[options.part]]
    else:
        lines = [f"{len(found.crashes)} crashes: {len(found.training)} to train on, {len(found.held_out)} held out"]
        for name, crashes in parts.items():
            lines += [f"{name:<8}  {crash.name}  seed {crash.seed}" for crash in crashes]
        if found.faults:
            lines.append(f"omitted: {found.faults} software faults")
    if lines:
        options.say("\n".join(lines))
    options.print_json(found.to_json())
    return DONE
