"""Go-back-N's bookkeeping, without a network."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.ledger import Ledger, Verdict


def judge(ledger: Ledger[str], epoch: int, sequence: int, base: int) -> Verdict:
    """Judges a batch of writer 1; NEXT ones start to wait."""
    verdict, state = ledger.judge(writer=1, epoch=epoch, sequence=sequence, base=base)
    if verdict is Verdict.NEXT:
        state.waiting.append(f"{epoch}/{sequence}")
    return verdict


def store_all(ledger: Ledger[str]) -> list[str]:
    """Stores what waits."""
    stored = []
    for state in ledger:
        while state.waiting:
            stored.append(state.waiting[0])
            ledger.stored(state, 1)
    return stored


def test_a_writers_life() -> None:
    ledger: Ledger[str] = Ledger()
    assert judge(ledger, 1, 0, 0) is Verdict.NEXT
    assert judge(ledger, 1, 1, 0) is Verdict.NEXT
    assert judge(ledger, 1, 3, 0) is Verdict.GAP
    assert judge(ledger, 1, 1, 0) is Verdict.REPLACES
    assert store_all(ledger) == ["1/0", "1/1"]
    assert judge(ledger, 1, 1, 0) is Verdict.DUPLICATE
    assert judge(ledger, 1, 2, 2) is Verdict.NEXT
    assert judge(ledger, 2, 0, 0) is Verdict.NEXT  # the process was restarted
    assert list(ledger.dropped) == ["1/2"]
    assert judge(ledger, 1, 3, 2) is Verdict.STALE
    assert store_all(ledger) == ["2/0"]
    assert [(s.epoch, s.next_sequence, s.rows) for s in ledger] == [(2, 1, 3)]


def test_a_service_without_memory_takes_the_writer_up_at_its_base() -> None:
    """58 comes before 57 after a reconnect: taking 58 first would lose 57."""
    ledger: Ledger[str] = Ledger()
    assert judge(ledger, 1, 58, 57) is Verdict.GAP
    assert judge(ledger, 1, 57, 57) is Verdict.NEXT
    assert judge(ledger, 1, 58, 57) is Verdict.NEXT
    assert store_all(ledger) == ["1/57", "1/58"]


def test_a_late_copy_does_not_hold_the_writer_below_what_was_acknowledged() -> None:
    """58 (base 57) was on the way when 57 was acknowledged and the service died."""
    ledger: Ledger[str] = Ledger()
    assert judge(ledger, 1, 58, 57) is Verdict.GAP
    assert judge(ledger, 1, 58, 58) is Verdict.NEXT


@given(data=st.data())
def test_every_batch_is_stored_once_in_order_through_loss_and_repeats(
    data: st.DataObject,
) -> None:
    """A link that loses, repeats and reorders; the sender resends from its base."""
    ledger: Ledger[str] = Ledger()
    stored: list[str] = []
    base = 0
    for _ in range(60):
        if base == 8:
            break
        sent = data.draw(st.lists(st.integers(max(0, base - 2), min(base + 3, 7))))
        for sequence in [*sent, base]:
            judge(ledger, 1, sequence, min(base, sequence))
            if data.draw(st.booleans()):
                stored += store_all(ledger)
        stored += store_all(ledger)
        base = next(iter(ledger)).next_sequence
    assert stored == [f"1/{sequence}" for sequence in range(base)]
    assert base == 8


@pytest.mark.parametrize("writers", [3])
def test_writers_do_not_mix(writers: int) -> None:
    ledger: Ledger[str] = Ledger()
    for writer in range(writers):
        verdict, _ = ledger.judge(writer=writer, epoch=writer, sequence=0, base=0)
        assert verdict is Verdict.NEXT
    assert [state.writer for state in ledger] == [0, 1, 2]
