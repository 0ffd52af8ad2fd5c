"""Draw the figures of the concept pages as SVG, for light and dark screens.

Figures of data hunt first: the commands and seeds are in this file, so every run draws the same figures.
usage: scripts/tools/figures [NAME…]   (all figures unless some are named; about three minutes)
"""

from __future__ import annotations

import math
import sys
import tempfile
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from gallery import command_line

from crashhunt.hunts import spec_of
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, sampler_of
from crashhunt.results import HuntResults
from crashhunt.statistics import RateTest
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / ".github" / "images"
WIDTH = 480  # of the drawing: text of 14 units stays readable on a telephone
HUNTS = 21  # of which the search figure shows the one with the median number of trials

RING = ("run", "ring", "2", "60", "900", "--scenario", "loop", "--seed", "1", "--deterministic")
CROSSING = (
    "run", "crossing", "2", "200", "900", "--scenario", "intersection", "--seed", "7", "--keep-going",
    "--deterministic",
)  # fmt: skip
JUDGED = "000195-collision"

STYLE = """\
:root { --page: #ffffff; --text: #1b2430; --faint: #5d6b7d; --line: #d3dae3; --car: #8d9aab; --road: #eef1f5;
  --blue: #1f5fbf; --red: #c62828; --green: #1b7f4d; --band: #cfe0f7; }
@media (prefers-color-scheme: dark) {
:root { --page: #12171e; --text: #e6ebf2; --faint: #9aa8ba; --line: #38434f; --car: #76859a; --road: #1d252f;
  --blue: #7db0ff; --red: #ff7b72; --green: #56d397; --band: #23415f; }
}
text { fill: var(--text); } .faint { fill: var(--faint); } .red { fill: var(--red); } .blue { fill: var(--blue); }
.green { fill: var(--green); } .end { text-anchor: end; } .mid { text-anchor: middle; } .bold { font-weight: 600; }
.line { stroke: var(--line); fill: none; } .curve { stroke: var(--blue); stroke-width: 2.5; fill: none; }
.mark { stroke: var(--red); stroke-width: 2.5; fill: none; }
.ring { stroke: var(--green); stroke-width: 2.5; fill: none; }
.dash { stroke: var(--faint); stroke-dasharray: 5 4; fill: none; } .band { fill: var(--band); }
.road { fill: var(--road); } .car { fill: var(--car); } .box { fill: var(--road); stroke: var(--line); }
.open { fill: none; stroke: var(--faint); stroke-width: 1.5; }
.halo { paint-order: stroke; stroke: var(--page); stroke-width: 3; } .dot { fill: var(--faint); opacity: 0.55; }
.way { stroke: var(--text); stroke-width: 2; fill: none; }"""


def drawing(title: str, height: float, parts: list[str]) -> str:
    """Return an SVG of parts on a page of the colours of the screen."""
    return "\n".join(
        [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" '
                'font-family="system-ui, sans-serif" font-size="14">'
            ),
            f"<title>{escape(title)}</title>",
            f"<style>{STYLE}</style>",
            f'<rect width="{WIDTH}" height="{height:g}" fill="var(--page)"/>',
            *parts,
            "</svg>\n",
        ]
    )


def text(x: float, y: float, words: str, kind: str = "") -> str:
    """Return a line of text."""
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{kind}">{escape(words)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, kind: str = "line") -> str:
    """Return a straight line."""
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" class="{kind}"/>'


def path(points: list[tuple[float, float]], kind: str = "curve") -> str:
    """Return a line through points."""
    return f'<path class="{kind}" d="M{" L".join(f"{x:.1f} {y:.1f}" for x, y in points)}"/>'


def cross(x: float, y: float, size: float = 5) -> str:
    """Return the mark of a crash."""
    way = f"l{2 * size} {2 * size}m0 {-2 * size}l{-2 * size} {2 * size}"
    return f'<path class="mark" d="M{x - size:.1f} {y - size:.1f}{way}"/>'


def scale(low: float, high: float, first: float, last: float) -> Callable[[float], float]:
    """Return the function from a value within an interval to a coordinate."""
    return lambda value: first + (value - low) / (high - low) * (last - first)


def hunted(words: tuple[str, ...], folder: Path) -> None:
    """Run a hunt unless another figure has run it."""
    if not (folder / words[1]).exists():
        command_line(*words, folder=folder)


def criticality(folder: Path) -> str:
    """Draw gap and criticality in the last 12 s before a rear-end collision."""
    hunted(RING, folder)
    shown = command_line("show", "ring", "--last-seconds", "12", folder=folder)
    steps = [step for step in shown["danger"]["steps"] if step["own"] is not None]
    moments = {moment["step"]: moment for moment in shown["moments"]}
    end = shown["moments"][-1]["time_s"]
    at = scale(-12, 0, 48, 466)
    gap, own = scale(0, 24, 150, 36), scale(0, 1, 312, 196)
    gaps = [(at(m["time_s"] - end), gap(m["gap_to_other_m"])) for m in moments.values()]
    curve = [(at(moments[step["step"]]["time_s"] - end), own(step["own"])) for step in steps if step["step"] in moments]
    last = shown["last_escape_step"]
    parts = [text(12, 22, f"Gap between ego and {shown['other']} in m", "bold")]
    parts += [line(48, gap(value), 466, gap(value)) for value in (0, 10, 20)]
    parts += [text(40, gap(value) + 5, f"{value}", "faint end") for value in (0, 10, 20)]
    parts += [path(gaps), text(12, 184, "Criticality of each step", "bold")]
    parts += [line(48, own(value), 466, own(value)) for value in (0, 0.5, 1)]
    parts += [text(40, own(value) + 5, f"{value:g}", "faint end") for value in (0, 0.5, 1)]
    parts.append(path([(curve[0][0], own(0)), *curve, (curve[-1][0], own(0))], "band"))
    parts.append(path(curve))
    parts += [text(at(value), 332, f"{value}", "faint mid") for value in (-12, -9, -6, -3, 0)]
    escape_x = at(moments[last]["time_s"] - end)
    parts += [line(escape_x, 36, escape_x, 312, "dash"), text(escape_x - 6, 50, "last avoidable step", "faint end")]
    parts.append(text(257, 352, "seconds before the contact", "faint mid"))
    return drawing("Gap and criticality before a rear-end collision", 362, parts)


def car(x: float, y: float, angle: float = 0, at_fault: bool = False, name: str = "") -> str:
    """Return a vehicle from above, which drives to the right unless it is turned."""
    kind = "red" if at_fault else "car"
    label = text(x, y + 24, name, "faint mid") if name else ""
    return (
        f'<g transform="translate({x} {y}) rotate({angle})"><rect x="-19" y="-9" width="38" height="18" rx="5" '
        f'class="{kind}"/><path d="M6 -6l6 6l-6 6" fill="none" stroke="var(--page)" stroke-width="2"/></g>{label}'
    )


def fault(_folder: Path) -> str:
    """Draw four rules, with the vehicle at fault in red."""
    parts = []
    for place, title in enumerate(("Rear end", "Lane change", "Right of way", "Red light")):
        x, y = 10 + 236 * (place % 2), 10 + 176 * (place // 2)
        parts.append(f'<g transform="translate({x} {y})"><rect width="224" height="164" rx="8" class="box"/>')
        parts.append(text(12, 24, title, "bold"))
        if place == 0:
            parts += [line(8, 58, 216, 58), line(8, 118, 216, 118), car(70, 94, at_fault=True), car(178, 94)]
            parts += [line(92, 82, 156, 82, "way"), text(124, 77, "gap too small", "faint mid")]
            parts.append(text(112, 148, "drives into the vehicle ahead", "faint mid"))
        elif place == 1:
            parts += [line(8, 44, 216, 44), line(8, 84, 216, 84, "dash"), line(8, 124, 216, 124)]
            parts += [car(84, 104), car(112, 66, 22, at_fault=True)]
            parts += [
                path([(130, 73), (168, 96)], "way"),
                text(112, 148, "changes into a gap too small", "faint mid"),
            ]
        elif place == 2:
            parts += [line(8, 62, 90, 62), line(8, 104, 90, 104), line(134, 62, 216, 62), line(134, 104, 216, 104)]
            parts += [line(90, 40, 90, 62), line(134, 40, 134, 62), line(90, 104, 90, 134), line(134, 104, 134, 134)]
            parts += [car(40, 83), car(112, 116, -90, at_fault=True), path([(62, 83), (96, 83)], "way")]
            parts += [path([(112, 94), (112, 72)], "way"), text(112, 155, "must give way and does not", "faint mid")]
        else:
            parts += [line(8, 62, 216, 62), line(8, 110, 216, 110), line(132, 62, 132, 110, "mark")]
            parts += [car(176, 86, at_fault=True), '<circle cx="132" cy="46" r="7" class="red"/>']
            parts += [path([(60, 86), (120, 86)], "dash"), text(112, 148, "passes the stop line at red", "faint mid")]
        parts.append("</g>")
    return drawing("Four rules that find the vehicle at fault, drawn in red", 358, parts)


def determinism(folder: Path) -> str:
    """Draw a trial and its replay as chains of digests, with the digest of a real crash."""
    hunted(RING, folder)
    done = command_line("replay", "ring", folder=folder)
    digest, steps = done["digest_recorded"], done["steps_recorded"]
    if done["digest_replayed"] != digest:
        sys.exit("determinism: the crash does not reproduce")
    parts = [
        '<rect x="90" y="10" width="300" height="52" rx="8" class="box"/>',
        text(240, 31, "Specification of the trial", "bold mid"),
        text(240, 51, "seed, arguments, code of the snapshot", "faint mid"),
    ]
    for row, (title, y) in enumerate((("Hunt: one forked process per trial", 92), ("Replay: a new process", 202))):
        parts.append(f'<rect x="10" y="{y}" width="460" height="92" rx="8" class="box"/>')
        parts.append(text(24, y + 22, title, "bold"))
        x = (44, 112, 180, 292)
        names = ("1", "2", "3", f"{steps}")
        for number, (at, name) in enumerate(zip(x, names, strict=True)):
            parts.append(f'<circle cx="{at}" cy="{y + 56}" r="19" class="band"/>')
            parts.append(text(at, y + 61, name, "mid"))
            if number:
                start = x[number - 1] + 21
                parts.append(line(start, y + 56, at - 21, y + 56, "dash" if number == 3 else "way"))
        parts += [line(313, y + 56, 344, y + 56, "way"), text(350, y + 61, f"{digest[:8]}…", "blue bold")]
        if row == 0:
            parts.append(path([(240, 62), (240, 92)], "way"))
    parts += [path([(388, 164), (388, 242)], "ring"), text(380, 198, "equal: bit-identical", "green end")]
    parts.append(text(240, 318, "Each circle is a step. It extends the digest by the bytes of", "faint mid"))
    parts.append(text(240, 336, "all observations, actions and actors of that step.", "faint mid"))
    return drawing("A trial and its replay: equal digests mean bit-identical runs", 348, parts)


def proposals(name: str, rate: float, seed: int) -> list[tuple[float, float, bool]]:
    """Return the trials of a sampler up to its first crash: both arguments, and whether it crashed.

    The crash region is a disc of which the position and size are known, so no simulator is needed.
    """
    radius = math.sqrt(rate / math.pi)
    center = np.array([0.78, 0.31])
    specs = {axis: ArgumentSpec(spec="0.0:1.0", kind="float") for axis in ("x", "y")}
    settings = HuntSettings(
        scenario="disc", scenario_digest="", trials=0, max_steps=1, seed=seed, sampler=name,
        agents={"ego": AgentSettings(agent="keep-lane", arguments=specs)},
    )  # fmt: skip
    sampler = sampler_of(settings)
    found: list[tuple[float, float, bool]] = []
    while not any(crashed for *_, crashed in found):
        spec = spec_of(len(found), settings, sampler)
        values = np.array([*spec.arguments["ego"].values()], float)
        away = float(np.linalg.norm(values - center)) - radius
        outcome = Outcome.COLLISION if away < 0 else Outcome.SURVIVED
        found.append((float(values[0]), float(values[1]), away < 0))
        if sampler.learns:
            sampler.tell(TrialResult(spec, outcome, steps=1, danger=1.0 if away < 0 else 0.95 * max(0.0, 1 - away)))
    return found


def search(_folder: Path) -> str:
    """Draw the trials of random draws and of the guided search up to the first crash."""
    rate = 1 / 500
    radius = math.sqrt(rate / math.pi)
    parts = []
    for place, name in enumerate(("random", "guided")):
        left = 12 + 236 * place
        x, y = scale(0, 1, left, left + 220), scale(0, 1, 252, 32)
        found = sorted((proposals(name, rate, seed) for seed in range(HUNTS)), key=len)[HUNTS // 2]
        parts.append(text(left, 22, f"{name}: {len(found)} trials", "bold"))
        parts.append(f'<rect x="{left}" y="32" width="220" height="220" class="box"/>')
        parts.append(f'<circle cx="{x(0.78):.1f}" cy="{y(0.31):.1f}" r="{radius * 220 + 5:.1f}" class="ring"/>')
        parts += [
            f'<circle cx="{x(a):.1f}" cy="{y(b):.1f}" r="2.5" class="dot"/>' for a, b, crashed in found if not crashed
        ]
        parts += [cross(x(a), y(b)) for a, b, crashed in found if crashed]
    parts.append(text(12, 276, "Each dot is a trial with two arguments. Green: the region of", "faint"))
    parts.append(text(12, 294, "crashes, 1 in 500 random trials. Red: the first crash.", "faint"))
    return drawing("Trials of random draws and of a guided search up to the first crash", 304, parts)


def counterfactuals(folder: Path) -> str:
    """Draw the runs of judge: one row per manoeuvre, one mark per run."""
    hunted(CROSSING, folder)
    words = ("judge", "crossing", "--crash", JUDGED, "--runs", "120", "--why", "0", "--reference", "0")
    (judged,) = command_line(*words, folder=folder)["judged"]
    attempts = judged["attempts"]
    steps = sorted({int(step) for attempt in attempts for step in attempt["endings"]})
    at = scale(steps[0], steps[-1], 118, 460)
    titles = {"brake": "brake", "left": "left, brake", "right": "right, brake"}
    parts = [text(12, 22, "Override the agent after this step, then …", "bold")]
    for row, attempt in enumerate(attempts):
        y = 58 + 42 * row
        parts += [text(12, y + 5, titles[attempt["manoeuvre"]]), line(110, y, 468, y)]
        for step, ending in sorted((int(step), ending) for step, ending in attempt["endings"].items()):
            if ending == "avoided":
                parts.append(f'<circle cx="{at(step):.1f}" cy="{y}" r="6" class="green"/>')
            elif ending in ("hit", "other"):
                parts.append(cross(at(step), y))
            else:
                parts.append(f'<circle cx="{at(step):.1f}" cy="{y}" r="5" class="open"/>')
    bottom = 58 + 42 * len(attempts)
    last = judged["last_step"]
    parts.append(line((at(last) + at(last + 1)) / 2, 34, (at(last) + at(last + 1)) / 2, bottom - 16, "dash"))
    shown = [step for step in (steps[0], 199, last, 205, steps[-1]) if steps[0] <= step <= steps[-1]]
    parts += [text(at(step), bottom + 4, f"{step}", "faint mid") for step in dict.fromkeys(shown)]
    legend = bottom + 30
    parts += [f'<circle cx="18" cy="{legend - 5}" r="6" class="green"/>', text(32, legend, "crash avoided")]
    parts += [cross(152, legend - 5), text(166, legend, "still a crash")]
    parts += [f'<circle cx="282" cy="{legend - 5}" r="5" class="open"/>', text(296, legend, "manoeuvre not possible")]
    return drawing("Runs of crashhunt judge: after which step a manoeuvre avoids the crash", legend + 14, parts)


def rates(folder: Path) -> str:
    """Draw the crash rate and its certain interval while a hunt of 200 trials runs."""
    hunted(CROSSING, folder)
    test, rows = RateTest(), []
    for number, trial in enumerate(HuntResults(folder / "crossing").results(), 1):
        test.add(float(trial.outcome is Outcome.COLLISION))
        rows.append((number, *test.interval(), float(test.observed or 0)))
    (reported,) = (rate for rate in command_line("rate", "crossing", folder=folder)["rates"] if rate["per"] == "trial")
    if not math.isclose(reported["certain"]["low"], rows[-1][1], rel_tol=1e-6):
        sys.exit(f"rates: the figure has {rows[-1]}, and crashhunt rate reports {reported['certain']}")
    x, y = scale(0, len(rows), 52, 466), scale(0, 0.4, 240, 36)
    parts = [text(12, 22, "Crashes per trial", "bold")]
    parts += [line(52, y(value), 466, y(value)) for value in (0, 0.1, 0.2, 0.3, 0.4)]
    parts += [text(44, y(value) + 5, f"{value:g}", "faint end") for value in (0, 0.1, 0.2, 0.3, 0.4)]
    upper = [(x(number), y(min(0.4, high))) for number, _, high, _ in rows]
    lower = [(x(number), y(low)) for number, low, _, _ in rows]
    parts.append(path([*upper, *reversed(lower)], "band"))
    parts += [path([(x(number), y(min(0.4, mean))) for number, _, _, mean in rows])]
    final = rows[-1]
    parts.append(text(460, upper[-1][1] - 6, f"at most {final[2]:.2f}", "end"))
    parts.append(text(460, y(final[3]) - 8, f"estimate {final[3]:.3f}", "blue bold end"))
    parts.append(text(460, lower[-1][1] + 16, f"at least {final[1]:.3f}", "end halo"))
    parts += [text(x(number), 258, f"{number}", "faint mid") for number in range(0, len(rows) + 1, 50)]
    parts.append(text(259, 278, "trials", "faint mid"))
    return drawing("Crash rate with its certain interval while a hunt runs", 288, parts)


DRAWINGS: dict[str, Callable[[Path], str]] = {
    "criticality": criticality, "fault": fault, "determinism": determinism, "search": search,
    "counterfactuals": counterfactuals, "rates": rates,
}  # fmt: skip


def main(names: list[str]) -> None:
    """Write the figures."""
    if unknown := [name for name in names if name not in DRAWINGS]:
        sys.exit(f"no figure {unknown[0]!r} (there are {', '.join(DRAWINGS)})")
    with tempfile.TemporaryDirectory(prefix="figures-") as folder:
        for name in names or DRAWINGS:
            (IMAGES / f"concept-{name}.svg").write_text(DRAWINGS[name](Path(folder)), encoding="utf-8")
            print(f"concept-{name}.svg", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
