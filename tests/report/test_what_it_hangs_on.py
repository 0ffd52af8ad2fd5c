"""What a judged collision hangs on, in words."""

from __future__ import annotations

import pytest

from crashhunt.crashes import Attempt, Factor, Judgement, LeftOut, Why
from crashhunt.report._cause_words import about_why
from crashhunt.report._judgement_words import about_judgement


@pytest.mark.parametrize("drawn", [(), ("unclear", "unclear")])
def test_a_default_is_reported_where_other_values_say_nothing(drawn):
    default = Factor("argument", "ego.speed", "default", was=9.0, runs=(LeftOut(5.0, "none"),))
    others = Factor("argument", "ego.speed", "drawn", was=9.0, runs=tuple(LeftOut(6.0, one) for one in drawn))
    assert about_why(Why((default, others), 100), str)[1:] == ["- ego.speed at its default 5: no crash."]


@pytest.mark.parametrize(("ends", "said"), [
    (("other", "none", "none"), "1 of 3 runs crashes (6.15 % to 79.2 %), another crash."),
    (("other", "other", "none"), "2 of 3 runs crash (20.8 % to 93.9 %), none of them the same crash."),
    (("same", "other", "none"), "2 of 3 runs crash (20.8 % to 93.9 %), 1 of them the same crash."),
    (("same", "none", "none"), "1 of 3 runs crashes (6.15 % to 79.2 %)."),
])  # fmt: skip
def test_runs_with_other_values_are_counted_in_words(ends, said):
    others = Factor("argument", "ego.speed", "drawn", was=9.0, runs=tuple(LeftOut(6.0, one) for one in ends))
    assert about_why(Why((others,), 100), str)[-1].endswith(f": {said}")


def test_that_braking_helped_from_the_first_step_on_is_reported_next_to_what_helped_longer():
    brake, left = Attempt("brake", 3, {0: "avoided", 1: "hit", 2: "hit"}), Attempt("left", 3, {2: "avoided"})
    told = about_judgement(Judgement((brake, left)), lambda step: f"step {step}", "ego", "other")
    assert [sentence.partition(",")[0] for sentence in told[:2]] == [
        "It could be avoided until step 2", "It could be avoided until step 0",
    ]  # fmt: skip


@pytest.mark.parametrize("others", [0, 2])
def test_other_crashes_in_place_of_this_one_are_reported(others):
    endings = {0: "other" if others else "hit", 1: "hit", 2: "other" if others else "hit"}
    told = about_judgement(Judgement((Attempt("brake", 3, endings),)), str, "ego", "other")
    what = "ended without a crash" if others else "avoided it"
    assert told[0] == f"None of 3 runs {what} by braking, from the first step on."
    unsettled = Judgement((Attempt("brake", 3, endings),), why_not="it took too long")
    doubt = about_judgement(unsettled, str, "ego", "other")
    assert doubt[0] == f"None of 3 runs {what}, but they do not prove that it was unavoidable."
    assert ("In 2 of them, another crash happened instead." in doubt) == bool(others)
    late = Judgement((Attempt("brake", 3, {0: "unclear", **{k: endings[k] for k in (1, 2)}}),), visible_step=1)
    seen = about_judgement(late, str, "ego", "other")[-1]
    assert ("the crash was already unavoidable" in seen) != bool(others)
    assert ("no later run ended without a crash; in 1 of them, another crash" in seen) == bool(others)
    assert ("In 2 of them, another crash happened instead." in told) == bool(others)


@pytest.mark.parametrize(("end", "endings", "said"), [
    (4, {0: "avoided", 1: "hit", 2: "hit", 3: "hit"}, "avoids it, and runs from all later steps crash."),
    (4, {0: "avoided", 1: "hit"}, "avoids it, and a run from one step later crashes."),
    (4, {0: "avoided", 3: "hit"}, "avoids it."), (1, {0: "avoided"}, "avoids it."),
])  # fmt: skip
def test_later_runs_are_reported_as_far_as_they_were_made(end, endings, said):
    (told,) = about_judgement(Judgement((Attempt("brake", end, endings),)), str, "ego", "other")
    assert told == f"It could be avoided until 0, by braking: a run from this step {said}"


@pytest.mark.parametrize(("visible", "runs", "said"), [
    (0, {0: "avoided"}, ["ego first observed other at the start."]),
    (1, {0: "avoided"}, ["ego first observed other step 1."]),
    (1, {}, []), (None, {0: "avoided"}, []),
])  # fmt: skip
def test_first_observation_is_reported_of_a_crash_with_runs(visible, runs, said):
    judgement = Judgement((Attempt("brake", 3, runs),), visible_step=visible)
    told = about_judgement(judgement, lambda step: f"step {step}", "ego", "other")
    assert [sentence for sentence in told if "observed" in sentence] == said


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (("seed", "", "drawn"), "other seeds, and so other traffic"),
        (("argument", "ego.speed", "drawn"), "other values of ego.speed (it was 9)"),
        (("actor", "x", "there"), "without x (taken off the road after step 5)"),
        (("actor", "x", "braked"), "x braked at 7; without that (it keeps its speed)"),
        (("disturbance", "x", "brake"), "without the disturbance brake of x at 7"),
    ],
)
def test_factor_is_named_by_its_kind(factor, words):
    kind, name, what = factor
    one = Factor(kind, name, what, was=9.0, step=7, runs=(LeftOut(5.0, "none"),))
    assert about_why(Why((one,), 100), str)[1] == f"- {words}: no crash."


def test_strongest_cause_comes_first():
    def factor(name, *endings):
        return Factor("argument", name, "drawn", was=9.0, runs=tuple(LeftOut(5.0, one) for one in endings))

    weak, strong, middle = (
        factor("a", "same", "same", "none"),
        factor("b", "none", "none"),
        factor("c", "same", "other"),
    )
    found = about_why(Why((weak, strong, middle), 100), str)[1:]
    assert [line.split()[4] for line in found] == ["b", "c", "a"]
