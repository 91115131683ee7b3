"""Gate, driver and node together: whatever becomes of the frames between them, no comb steps beyond the slew limit."""

from hypothesis import example, given, settings
from hypothesis import strategies as st
from linked_rig import FATES, STEP, Linked

Tick = tuple[int | None, str, str]


def up(level: int) -> tuple[int, int, int]:
    return level, level, level


def test_a_drive_frame_in_every_other_tick_makes_no_step_of_120_v() -> None:
    """Each was refused by the node as late, and each counted by the gate as applied: six steps came at once."""
    linked = Linked()
    level = 0
    for k in range(12):
        level = min(level + STEP, 32767) if k % 2 else level
        linked.tick(up(level) if k % 2 else None)
    for _ in range(3):
        linked.tick(up(level))
    assert linked.worst_step() <= STEP
    assert any("must come first" in reason for reason in linked.blocked)


def test_without_a_disturbance_every_step_that_passed_is_made() -> None:
    linked = Linked()
    levels = [*range(0, 32767, STEP), *range(32767, 0, -STEP)]
    for level in levels:
        assert linked.tick(up(level))
    linked.tick(up(0))
    assert linked.blocked == []
    made = [counts for _, counts in linked.plant.driven]
    assert made[1:] == [up(level) for level in levels]  # the first is the start's
    assert linked.worst_step() == STEP


def test_lost_syncs_make_no_step_of_what_was_sent_meanwhile() -> None:
    for lost in range(1, 8):
        linked = Linked()
        for k in range(1, 4):
            linked.tick(up(k * STEP // 2))
        for k in range(4, 4 + lost):
            linked.tick(up(k * STEP // 2), sync="lost")
        before = len(linked.plant.driven)
        linked.tick(up((4 + lost) * STEP // 2))
        after = [counts for _, counts in linked.plant.driven[before:]]
        assert after == [(0, 0, 0)], lost  # one that was missed is noticed by its counter, and ends at 0 V
        assert linked.node.outputs == (0, 0, 0)


def test_exactly_240_lost_syncs_are_seen_in_no_counter_and_end_at_0_v_all_the_same() -> None:
    linked = Linked()
    for k in range(1, 4):
        linked.tick(up(k * STEP))
    for k in range(240):
        linked.tick(up((k + 4) % 10 * STEP if k else 4 * STEP), sync="lost")
    for _ in range(4):
        linked.tick(up(10 * STEP))
    assert linked.worst_step() <= STEP


def test_a_lost_drive_frame_makes_no_step_of_two() -> None:
    """The node refuses the one behind it, for its counter; the third would be three steps from what the combs hold."""
    linked = Linked()
    linked.tick(up(STEP))
    linked.tick(up(2 * STEP), drive="lost")
    for k in range(3, 7):
        linked.tick(up(k * STEP))
    assert linked.worst_step() <= STEP
    assert linked.plant.driven[-1][1] == (0, 0, 0)
    assert linked.driver.node_events  # and the controller is told


@st.composite
def scripts(draw: st.DrawFn) -> list[Tick]:
    """Mostly ordinary ticks; levels in steps of the slew limit from the level before, or anything."""
    fate = st.sampled_from(("arrives",) * 5 + FATES)
    level = st.one_of(st.none(), st.sampled_from((-1, 0, 1, 1, 1)))
    return draw(st.lists(st.tuples(level, fate, fate), min_size=4, max_size=30))


@settings(max_examples=300)
@example([(1, "arrives", "arrives"), (1, "lost", "arrives"), (1, "arrives", "lost")])
@given(scripts())
def test_no_script_of_losses_makes_a_step_beyond_slew(script: list[Tick]) -> None:
    linked = Linked()
    level = 0
    for change, sync, drive in script:
        wanted = None if change is None else max(0, min(10, level + change))
        if linked.tick(None if wanted is None else up(wanted * STEP), sync, drive):
            level = level if wanted is None else wanted
        else:
            level = 0
            linked.tick(up(0))
    assert linked.worst_step() <= STEP
