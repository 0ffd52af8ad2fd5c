"""A scorecard as text for the terminal, as a page with maps, and as a table for a safety case."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

from crashhunt.base.text import aligned, command_line, count_of
from crashhunt.crashes import COMPETENT_DRIVERS
from crashhunt.report._judgement_words import DRIVER_NAMES
from crashhunt.report._page import player_parts

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.base.codec import JsonObject

_CELL = 11  # width and height of a case in a map, in pixels
_LEFT, _BELOW = 46, 30
_COLUMNS = ("group", "cases", "run", "crashes", *(DRIVER_NAMES[model] for model in COMPETENT_DRIVERS))


def describe_scorecard(card: JsonObject, directory: str) -> str:
    """Return the scorecard as text: the answer first, then the groups, then the files."""
    lines = [_answer(card)]
    if not card["complete"]:
        lines.append("The scorecard is not complete. Run the same command to resume.")
    rows = [[*_COLUMNS, "only the agent crashes"]]
    rows += [[*_cells(group), _share(group["preventable_by"]["cc_human"])] for group in card["groups"]]
    lines += ["", *aligned(rows), ""]
    lines += [f"{group['id']}: {group['why_not']}" for group in card["groups"] if not any(_known(group))]
    lines.append(
        "The columns of the four models contain the cases in which a model crashes. The last column is the share of "
        "cases in which the agent crashes and the careful human does not, with a 95 % interval."
    )
    lines.append(f"{count_of(card['ran'], 'case')} of {card['cases']:,} ran; the others end as the nearest case.")
    return "\n".join(lines) + f"\nPage, table and data: {command_line(directory)}/scorecard.html, .md, .json"


def _answer(card: JsonObject) -> str:
    share = card["preventable_by"]["cc_human"]
    if share is None or share["share"] is None:
        return f"{card['agent']}: there is no case yet in which the agent can be compared with a careful human"
    return f"In {_share(share)} of the cases, {card['agent']} crashes and a careful human does not"


def _known(group: JsonObject) -> Iterable[bool]:
    return (one is not None for one in group["preventable_by"].values())


def _cells(group: JsonObject) -> list[str]:
    crashes = ["-" if found is None else f"{found:,}" for found in group["crashes_of_drivers"].values()]
    agent = "-" if group["crashes"] is None else f"{group['crashes']:,}"
    return [group["id"], f"{group['cases']:,}", f"{group['ran']:,}", agent, *crashes]


def _share(share: Mapping[str, Any] | None) -> str:
    if share is None or share["share"] is None:
        return "-"
    low, high = share["interval"]
    return f"{share['share']:.1%} ({low:.1%} to {high:.1%})".replace("%", " %")


def scorecard_table(card: JsonObject) -> str:
    """Return the scorecard as Markdown for a safety case: results, versions, seeds and digests."""
    names = [DRIVER_NAMES[model] for model in COMPETENT_DRIVERS]
    lines = [
        f"# Scorecard {card['suite']}: {card['agent']}",
        "",
        f"{_method(card)}, {'complete' if card['complete'] else 'NOT COMPLETE'}.",
        "",
        _row([*_COLUMNS[:4], *(f"{name} crashes" for name in names), *(f"only the agent, {name}" for name in names)]),
        _row(["---"] * (4 + 2 * len(names))),
    ]
    lines += [
        _row([*_cells(group), *(_share(one) for one in group["preventable_by"].values())]) for group in card["groups"]
    ]
    total = ["all", f"{card['cases']:,}", f"{card['ran']:,}", *[""] * (1 + len(names))]
    lines.append(_row([*total, *(_share(one) for one in card["preventable_by"].values())]))
    lines += ["", "Intervals: 95 %, from cases drawn at random (Wilson; several hunts: MOVER).", ""]
    facts = [hunt for group in card["groups"] for hunt in group["hunts"]]
    columns = ("dir", "seed", "trials", "scenario_digest", "snapshot", "trials_digest")
    lines += [_row(columns), _row(["---"] * len(columns))]
    lines += [_row([str(hunt[name]) for name in columns]) for hunt in facts]
    versions = sorted({f"{name} {version}" for hunt in facts for name, version in hunt["versions"].items()})
    return "\n".join([*lines, "", f"Versions: {', '.join(versions)}.", ""])


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def scorecard_page(card: JsonObject) -> str:
    """Return the scorecard as one HTML page without scripts."""
    rows = [[*_cells(group), *(_share(one) for one in group["preventable_by"].values())] for group in card["groups"]]
    names = [DRIVER_NAMES[model] for model in COMPETENT_DRIVERS]
    parts = [
        f"<h1>Scorecard {_text(card['suite'])}: {_text(card['agent'])}</h1><p><b>{_text(_answer(card))}.</b></p>",
        "" if card["complete"] else "<p><b>Not complete.</b> Run the same command to resume.</p>",
        _key(),
        _table([*_COLUMNS, *(f"only the agent crashes, not: {name}" for name in names)], rows),
        *(_group(group) for group in card["groups"]),
        "<h2>Versions, seeds and digests</h2>",
        _facts(card),
    ]
    head = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Scorecard {_text(card["suite"])}: '
        f"{_text(card['agent'])}</title><style>{player_parts().style}{_STYLE}</style>"
    )
    return f"{head}<main>{''.join(parts)}</main></html>\n"


_STYLE = """
.hit { fill: var(--crash); } .only { fill: var(--fault); } .fine { fill: var(--line); } circle { fill: var(--text); }
.maps { display: flex; flex-wrap: wrap; gap: 4px 18px; } figure { margin: 0; } figcaption { font-size: 13px; }
svg text { fill: var(--faint); font: 10px system-ui, sans-serif; } table { border-collapse: collapse; }
td, th { border: 1px solid var(--line); padding: 3px 7px; text-align: left; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; }
"""


def _key() -> str:
    signs = (
        ("only", "", "the agent crashes, the careful human does not"),
        ("hit", "", "crash"),
        ("fine", "", "no crash"),
        ("fine", '<circle cx="5.5" cy="5.5" r="1.5"/>', "has run; a case that has not run ends like the nearest case"),
    )
    drawn = (
        f'<svg width="12" height="12"><rect width="11" height="11" class="{kind}"/>{dot}</svg> {words}'
        for kind, dot, words in signs
    )
    return f"<p>{' &ensp; '.join(drawn)}</p>"


def _text(value: object) -> str:
    return html.escape(str(value))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = "".join(f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return (
        f'<div class="scroll"><table><tr>{"".join(f"<th>{_text(one)}</th>" for one in head)}</tr>{lines}</table></div>'
    )


def _group(group: JsonObject) -> str:
    parts = [
        f"<h2>{_text(group['id'])} <small>({_text(group['scenario'])}, paragraph {group['paragraph']})</small></h2>"
    ]
    missing = [DRIVER_NAMES[model] for model, one in group["preventable_by"].items() if one is None]
    if missing:
        parts.append(f"<p>No answer of {_text(', '.join(missing))}: {_text(group['why_not'])}.</p>")
    for one in group["maps"]:
        fixed = ", ".join(f"{name} = {value}" for name, value in one["fixed"].items())
        competent = one["drivers"].get("cc_human")
        maps = [] if one["agent"] is None else [_map("agent", one, one["agent"], competent)]
        maps += [_map(DRIVER_NAMES[model], one, labels, None) for model, labels in one["drivers"].items()]
        parts.append(f'<h3>{_text(fixed)}</h3><div class="maps">{"".join(maps)}</div>')
    return "".join(parts)


def _map(
    title: str, data: JsonObject, labels: Sequence[Sequence[bool]], competent: Sequence[Sequence[bool]] | None
) -> str:
    x, y = data["x"], data["y"]
    columns, rows = len(x["values"]), len(y["values"])
    cells = []
    for row in range(rows):
        for column in range(columns):
            hit = labels[row][column]
            only = hit and competent is not None and not competent[row][column]
            kind = "only" if only else "hit" if hit else "fine"
            left, top = _LEFT + column * _CELL, (rows - 1 - row) * _CELL
            cells.append(f'<rect x="{left}" y="{top}" width="{_CELL - 1}" height="{_CELL - 1}" class="{kind}"/>')
            if title == "agent" and data["ran"][row][column]:
                cells.append(f'<circle cx="{left + 5}" cy="{top + 5}" r="1.5"/>')
    bottom = rows * _CELL
    ends = (
        (_LEFT, bottom + 11, "start", x["values"][0]),
        (_LEFT + columns * _CELL, bottom + 11, "end", x["values"][-1] if columns > 2 else ""),
        (_LEFT - 4, bottom - 2, "end", y["values"][0]),
        (_LEFT - 4, 9, "end", y["values"][-1] if rows > 1 else ""),
        (_LEFT, bottom + 24, "start", f"{x['name']} → / {y['name']} ↑"),
    )
    marks = "".join(
        f'<text x="{left}" y="{top}" text-anchor="{anchor}">{_text(_number(value))}</text>'
        for left, top, anchor, value in ends
    )
    width, height = max(_LEFT + columns * _CELL, _LEFT + 130), bottom + _BELOW
    hits = sum(map(sum, labels))
    label = f"{title}: crashes in {hits} of {rows * columns} cases"
    return (
        f'<figure><figcaption>{_text(title)}: {hits}</figcaption><svg width="{width}" height="{height}" role="img" '
        f'aria-label="{_text(label)}">{"".join(cells)}{marks}</svg></figure>'
    )


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _facts(card: JsonObject) -> str:
    facts = [hunt for group in card["groups"] for hunt in group["hunts"]]
    columns = ("dir", "seed", "trials", "scenario_digest", "snapshot", "trials_digest")
    versions = sorted({f"{name} {version}" for hunt in facts for name, version in hunt["versions"].items()})
    table = _table(columns, [[str(hunt[name]) for name in columns] for hunt in facts])
    return f"{table}<p>{_text(', '.join(versions))}; {_text(_method(card))}.</p>"


def _method(card: JsonObject) -> str:
    return f"crashhunt {card['crashhunt']}, method: {card['method']}, {card['steps']} steps of 0.1 s per case"
