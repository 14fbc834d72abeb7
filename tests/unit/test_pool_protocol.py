"""A model of how a pool settles. The test tries all interleavings of its threads.

The model has three threads of a pool (csrc/residency/pool_shared.h): one settles a view
and then draws it, one decides, and one reads. A step is what a thread does while it
holds the mutex, or what it does without it. Any thread that can do a step may do the
next one. The view needs a page, and another page below it. Its cut requests the lower
page only when the upper one is in the page table of its frame. An earlier frame with
another view may have left needs that the pool has not decided about. That decision may
load another page, and may raise the tolerance.

`RULES` are the rules by which the pool draws settled views completely. If any of them
is left out, the model finds an interleaving that draws a picture with a missing page or
at a raised tolerance.
"""

from dataclasses import dataclass, replace
from itertools import product

import pytest

UPPER, LOWER, OTHER = "upper", "lower", "other"
SETTLED_VIEW, EARLIER_VIEW = "settled", "earlier"
# The view is settled when the pool has decided about it and no page was missing in the
# page table of its own frame, which the cut used.
ABSENT_PAGES = "absent pages"
# Before a view is settled, earlier needs are discarded, and a round in progress is
# waited for.
CLEAN_START = "clean start"
RULES = frozenset({ABSENT_PAGES, CLEAN_START})


@dataclass(frozen=True)
class Needs:
    view: str
    pages: frozenset[str]


@dataclass(frozen=True)
class State:
    """The data that the threads share, and the next step of each thread."""

    step: str  # the next step of the thread that settles
    table: frozenset[str] = frozenset()  # the pages in its page table
    num_absent: int = 0  # the pages that its last cut missed
    noted: Needs | None = None
    decided_view: str = ""
    missing: int = 1
    has_noted: bool = False
    is_raised: bool = False
    ready: frozenset[str] = frozenset()
    # the needs that wait for the deciding thread
    resident: frozenset[str] = frozenset()
    todo: frozenset[str] = frozenset()
    loading: frozenset[str] = frozenset()
    read: frozenset[str] = frozenset()
    wants_round: bool = False
    is_served: bool = False  # whether the thread has waited for the round in progress
    round_is_over: bool = False
    is_deciding: bool = False
    decides: Needs | None = None
    loaded: frozenset[str] = frozenset()


def cut(table):
    """Return the pages that the view requests with this page table. It requests the
    lower page only if it has the upper one."""
    return frozenset({UPPER, LOWER}) if UPPER in table else frozenset({UPPER})


def may_note(state):
    return state.noted is not None and (not state.has_noted or not state.ready)


def settling_steps(state, rules):
    """Yield the steps that the settling thread can do next."""
    if state.step == "start":
        if CLEAN_START in rules:
            if not state.is_deciding:
                yield replace(state, step="begin", noted=None, is_raised=False)
        else:
            yield replace(state, step="begin", is_raised=False)
    elif state.step == "begin":
        yield replace(state, step="wait to take", wants_round=True, round_is_over=False)
    elif state.step == "wait to take" and state.round_is_over:
        table = state.table | state.ready
        yield replace(
            state,
            step="cut",
            table=table,
            ready=frozenset(),
            has_noted=False,
            round_is_over=False,
        )
    elif state.step == "cut":
        needs = Needs(SETTLED_VIEW, cut(state.table))
        yield replace(
            state,
            step="wait to know",
            noted=needs,
            num_absent=len(needs.pages - state.table),
            wants_round=True,
            round_is_over=False,
        )
    elif state.step == "wait to know" and state.round_is_over:
        is_known = ABSENT_PAGES not in rules or state.decided_view == SETTLED_VIEW
        num_missing = state.num_absent if ABSENT_PAGES in rules else state.missing
        step = "draw" if is_known and num_missing == 0 else "begin"
        yield replace(state, step=step, round_is_over=False)
    elif state.step == "draw":
        yield replace(state, step="drawn", table=state.table | state.ready)


def deciding_steps(state):
    """Yield the steps that the deciding thread can do next. It begins or ends a
    round."""
    if state.is_deciding:
        resident = state.resident | state.loaded
        after = replace(
            state,
            is_deciding=False,
            decides=None,
            loaded=frozenset(),
            resident=resident,
            ready=state.ready | state.loaded,
            round_is_over=state.round_is_over or state.is_served,
            is_served=False,
        )
        if state.decides is not None:
            # The needs are read first, so a page that arrives during this round is
            # recorded as missing.
            absent = state.decides.pages - state.resident
            after = replace(
                after,
                decided_view=state.decides.view,
                missing=len(absent),
                todo=absent,
                is_raised=after.is_raised or state.decides.view == EARLIER_VIEW,
            )
        yield after
    elif state.wants_round or may_note(state) or state.read:
        decides = state.noted if may_note(state) else None
        yield replace(
            state,
            is_deciding=True,
            decides=decides,
            noted=None if decides is not None else state.noted,
            has_noted=state.has_noted or decides is not None,
            loaded=state.read,
            read=frozenset(),
            is_served=state.wants_round,
            wants_round=False,
        )


def reading_steps(state):
    """Yield the steps that a reading thread can do next. It begins or finishes a
    page."""
    for page in state.todo - state.loading - state.read - state.loaded - state.resident:
        yield replace(state, todo=state.todo - {page}, loading=state.loading | {page})
    for page in state.loading:
        yield replace(state, loading=state.loading - {page}, read=state.read | {page})


def starts():
    """Yield the states that an earlier frame may have left."""
    earlier = Needs(EARLIER_VIEW, frozenset({OTHER}))
    pages = [frozenset(), frozenset({UPPER}), frozenset({OTHER}), frozenset({UPPER, OTHER})]
    for noted, loading in product([None, earlier], pages):
        yield State("start", noted=noted, loading=loading)
        for decides in (None, earlier):
            yield State(
                "start",
                noted=noted,
                loading=loading,
                is_deciding=True,
                decides=decides,
                has_noted=decides is not None,
            )


def faults(rules):
    """Return the faults in states that can be reached, and the number of these
    states."""
    found = set()
    seen = set(starts())
    todo = list(seen)
    while todo:
        state = todo.pop()
        if state.step == "drawn":
            if cut(state.table) - state.table:
                found.add("a page is missing")
            if state.is_raised:
                found.add("the tolerance is raised")
            continue
        steps = [*settling_steps(state, rules), *deciding_steps(state), *reading_steps(state)]
        if not steps:
            found.add(f"nobody can go on at {state.step!r}")
        for after in steps:
            if after not in seen:
                seen.add(after)
                todo.append(after)
    return found, len(seen)


def test_a_settled_view_is_drawn_complete_whatever_the_interleaving():
    found, num_states = faults(RULES)
    assert found == set()
    assert num_states > 1000


@pytest.mark.parametrize(
    ("rule", "fault"),
    [
        (ABSENT_PAGES, "a page is missing"),
        (CLEAN_START, "the tolerance is raised"),
    ],
)
def test_no_rule_is_in_vain(rule, fault):
    assert fault in faults(RULES - {rule})[0]
