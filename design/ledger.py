"""Who holds what of a budget that several workers share, read off the trials of their study.

Nobody keeps an account: a trial's number says when it was asked for, so every worker that looks at
the same trials comes to the same answer, and no lock has to outlive a worker that is killed.

    waiting   to be run: an engineering row, or a layout to be tried again
    running   asked for by a worker, which gives signs of life
    complete  told, with what it cost
    failed    left behind by a worker that died or was interrupted ("lost"), or dropped
"""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState

#: User attributes of a trial. ORIGIN: where a layout that was given came from; PASSES: what running
#: it costs; WORKER: who was let run it; LOST: its worker left before it was told; RETRY_OF: number
#: of the lost trial of this layout; RETRIES: how often it was tried again; DROPPED: why it is not
#: run, TWIN or SURPLUS; RECORD: what it gave.
ORIGIN, PASSES, WORKER, LOST, RETRY_OF, RETRIES, DROPPED, RECORD = (
    "origin", "passes", "worker", "lost", "retry_of", "retries", "dropped", "record",
)  # fmt: skip
#: Asked for by another too; beyond the budget.
TWIN, SURPLUS = "twin", "surplus"
#: A layout that took its worker down so often is given up.
MOST_RETRIES = 5


def held(trials: Sequence[FrozenTrial], price: int) -> dict[int, int]:
    """What each trial, by number, holds of the budget [passes]: spent, being spent, or kept for a
    lost layout until it is tried again.

    Args:
        price: of a trial that does not say: one rollout of a layout.
    """
    kept = {t.number for t in owed(trials)}
    found, seen = {}, set()
    for t in sorted(trials, key=lambda t: t.number):
        attributes = t.user_attrs
        if RETRY_OF in attributes and not t.state.is_finished():
            # Two workers that note the same loss: one of their notes counts.
            if attributes[RETRY_OF] in seen:
                continue
            seen.add(attributes[RETRY_OF])
        if t.state == TrialState.COMPLETE:
            record = attributes.get(RECORD)
            if record is not None:
                found[t.number] = int(record["rollouts"]) + int(record["backwards"])
        elif t.state == TrialState.RUNNING:
            found[t.number] = int(attributes.get(PASSES, price))
        elif (t.state == TrialState.WAITING and RETRY_OF in attributes) or t.number in kept:
            found[t.number] = price
    return found


def owed(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Failed trials whose layout is not known, and that no trial is to try again yet.

    A retry that was dropped since another worker ran the layout just then leaves it owed: the other
    may be dropped in its turn.
    """
    settled = {
        t.user_attrs[RETRY_OF]
        for t in trials
        if RETRY_OF in t.user_attrs and t.user_attrs.get(DROPPED) != TWIN
    }
    done = _given(trials, TrialState.COMPLETE)
    return [
        t
        for t in trials
        if t.state == TrialState.FAIL
        and t.user_attrs.get(LOST)
        and t.number not in settled
        and int(t.user_attrs.get(RETRIES, 0)) < MOST_RETRIES
        and not _among(t, done, trials)
    ]


def lost(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Those of `owed` that nobody runs just now: to be tried again."""
    running = _given(trials, TrialState.RUNNING)
    return [t for t in owed(trials) if not _among(t, running, trials)]


def surplus(
    trials: Sequence[FrozenTrial], numbers: Sequence[int], budget: int, price: int
) -> set[int]:
    """Which of `numbers` have no room in the budget beside the trials that were asked before."""
    holds = held(trials, price)
    turn = _turns(trials)
    taken, beyond = 0, set()
    for number in sorted(holds, key=lambda number: (turn[number], number)):
        if number in numbers and taken + holds[number] > budget:
            beyond.add(number)
        else:
            taken += holds[number]
    return beyond


def _turns(trials: Sequence[FrozenTrial]) -> dict[int, int]:
    """Where each trial stands in the queue for the budget: where it was asked for, and a layout
    that is tried again where it was asked for first, or trials that were asked for before its
    worker was missed would take its room."""
    turn: dict[int, int] = {}
    for t in sorted(trials, key=lambda t: t.number):
        turn[t.number] = turn.get(t.user_attrs.get(RETRY_OF, t.number), t.number)
    return turn


def twins(trials: Sequence[FrozenTrial], numbers: Sequence[int], since: int = 0) -> set[int]:
    """Which of `numbers` are of a layout that an earlier trial holds, given and not sampled.

    The row that two workers both wanted to have tried, the layout from which both want to leap, the
    lost layout that both noted. A sampler may propose what it likes.

    Args:
        since: a chain of gradients may begin again where one was before that trial: a search that
            is resumed does.
    """
    found = set()
    given = [t for t in trials if ORIGIN in t.user_attrs and DROPPED not in t.user_attrs]
    for t in given:
        if t.number in numbers and any(_same(t, o, since) for o in given if o.number < t.number):
            found.add(t.number)
    return found


def _same(later: FrozenTrial, earlier: FrozenTrial, since: int) -> bool:
    ours, theirs = later.user_attrs, earlier.user_attrs
    if RETRY_OF in ours and ours[RETRY_OF] == theirs.get(RETRY_OF):
        return True
    if earlier.state == TrialState.FAIL:
        return False
    old = earlier.state == TrialState.COMPLETE and earlier.number < since
    return not (ours[ORIGIN] == "gradient" and old) and _same_given(later, earlier)


def _given(trials: Sequence[FrozenTrial], state: TrialState) -> list[FrozenTrial]:
    return [t for t in trials if ORIGIN in t.user_attrs and t.state == state]


def _among(one: FrozenTrial, others: Sequence[FrozenTrial], trials: Sequence[FrozenTrial]) -> bool:
    """Whether one of `others` is of the layout of a lost trial, as it was given or as it was tried
    again: what a sampler asked for is made buildable then, and may be what another was made."""
    again = [t for t in trials if t.user_attrs.get(RETRY_OF) == one.number]
    return any(_same_given(t, o) for t in (one, *again) for o in others if t.number != o.number)


def _same_given(one: FrozenTrial, other: FrozenTrial) -> bool:
    origins = [t.user_attrs.get(ORIGIN) for t in (one, other)]
    return origins[0] == origins[1] is not None and _same_place(one, other)


def _same_place(one: FrozenTrial, other: FrozenTrial) -> bool:
    a, b = (t.system_attrs.get("fixed_params") or t.params for t in (one, other))
    return bool(a) and a.keys() == b.keys() and all(_near(a[k], b[k]) for k in a)


def _near(one: object, other: object) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) < 1e-6
    return one == other
