"""Made-up episodes, written through the black box as an episode writes them."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

from crashhunt.episode import run_episode
from crashhunt.recording import (
    AgentChannel,
    BlackBox,
    Prologue,
    Recording,
    Tag,
    encode_actors,
    encode_events,
    encode_heights,
    encode_spines,
    read_black_box,
)
from crashhunt.trial import Outcome
from crashhunt.world import Actor, Contact, Roster, Scene

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.trial import TrialResult, TrialSpec

NAMES = ["ego", "left.25", "odd name/§ #1", "日本", "a.b"]


@dataclass
class Episode:
    """What to write."""

    agents: list[str]
    steps: int
    seed: int
    dtype: str = "<f4"
    unfinished: bool = False
    contact_at: int = -1


episodes = st.builds(
    Episode,
    agents=st.lists(st.sampled_from(NAMES), min_size=1, max_size=3, unique=True),
    steps=st.integers(0, 25),
    seed=st.integers(0, 2**32 - 1),
    dtype=st.sampled_from(["<f4", "<f8", "<i8", "|u1"]),
    unfinished=st.booleans(),
    contact_at=st.integers(-1, 25),
)


def write(episode: Episode, path: Path) -> int:
    """Write a black box; return how many bytes of records it has."""
    rng = np.random.default_rng(episode.seed)
    box = BlackBox(path)
    box.begin(pid=os.getpid(), trial=7, started=0.0)
    channels = tuple(AgentChannel(a, episode.dtype, (3, 2), "<f8", (2,), ("speed", "change")) for a in episode.agents)
    box.prologue(Prologue(channels, 0.1).encode(), len(channels))
    special = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e308]
    numbers: dict[Actor, int] = {}
    roster = None
    for step in range(episode.steps + 1):
        if step:
            for number in range(len(channels)):
                values = rng.choice([*special, *rng.normal(size=9)], size=(3, 2))
                with np.errstate(all="ignore"):
                    usable = values if "f" in episode.dtype else np.nan_to_num(values, posinf=1, neginf=0).clip(0, 200)
                    box.observation(number, usable.astype(episode.dtype))
                box.action(number, rng.normal(size=2))
        if roster is None or step % 7 == 0:
            others = [f"car {place}" for place in range(int(rng.integers(0, 6)))]
            roster = Roster(tuple(Actor(name, "passenger", 4.5, 1.8) for name in [*episode.agents, *others]))
            fresh = [actor for actor in roster.actors if actor not in numbers]
            if fresh:
                numbers.update(zip(fresh, range(len(numbers), len(numbers) + len(fresh)), strict=True))
                box.append(Tag.ACTORS, 0, encode_actors(fresh))
            box.append(Tag.ROSTER, 0, np.array([numbers[actor] for actor in roster.actors], "<u4").tobytes())
        count = len(roster)
        contacts = ()
        if step == episode.contact_at:
            contacts = (Contact(episode.agents[0], roster.actors[-1].id, "collision", "x_0", 3.0, 1.5),)
        lanes = tuple(f"edge {row}_0" for row in range(count)) if step % 10 == 0 or contacts else ()
        points = [tuple(map(float, point)) for point in rng.normal(scale=50, size=(count, 2))]
        headings, speeds = rng.uniform(-4, 2, count).tolist(), rng.uniform(0, 30, count).tolist()
        scene = Scene(20 + step * 0.1, roster, points, headings, speeds, contacts, (), lanes)
        if episode.seed % 3 == 0:
            scene.heights, scene.grades = rng.normal(size=(2, count)).tolist()
            if step % 4 == 1:
                scene.spines = {
                    row: tuple(map(tuple, rng.normal(size=(3 + row, 3)).tolist())) for row in range(2)[:count]
                }
        if lanes:
            box.append(Tag.LANES, 0, "\n".join(lanes).encode())
        if contacts:
            box.append(Tag.EVENTS, 0, encode_events(scene))
        if scene.heights:
            box.append(Tag.HEIGHTS, 0, encode_heights(scene))
        if scene.spines:
            box.append(Tag.SPINES, 0, encode_spines(scene))
        box.step(step, scene, tuple(rng.normal(size=len(channels)).tolist()))
    if episode.unfinished:
        box.observation(0, np.zeros((3, 2), episode.dtype))
    size = len(box.committed())
    box.close()
    return size


def record(episode: Episode, path: Path) -> Recording:
    """Write and read a black box."""
    write(episode, path)
    return Recording(read_black_box(path))


def record_run(
    path: Path, spec: TrialSpec, simulator: Any, agent: Any, **options: Any
) -> tuple[TrialResult, Recording]:
    """Run an episode with one agent; return its result and its recording."""
    with closing(BlackBox(path)) as box:
        box.begin(pid=1, trial=0, started=0.0)
        result = run_episode(spec, simulator=simulator, make_agent=lambda *_: agent, box=box, **options)
        recording = Recording(read_black_box(path))
    assert result.outcome is Outcome.INVALID or result.digest == recording.digest
    return result, recording
