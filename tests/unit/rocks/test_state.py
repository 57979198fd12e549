from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.rocks.state import ContactMemory, PileState, load_pile, save_pile


def test_round_trip_is_exact(heap, tmp_path):
    path = tmp_path / "pile.npz"
    save_pile(heap, path)
    back = load_pile(path)
    for name in ("p_WRs", "q_WRs", "V_WRs", "shape", "size", "fixed"):
        assert np.array_equal(getattr(back, name), getattr(heap, name))
    assert back.provenance == heap.provenance


def test_every_damaged_byte_is_noticed(heap, tmp_path):
    path = tmp_path / "pile.npz"
    save_pile(heap, path)
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    same = 0
    for at in rng.integers(0, len(data), 40):
        broken = bytearray(data)
        broken[at] ^= 0xFF
        path.write_bytes(broken)
        try:
            back = load_pile(path)
        except InputError:
            continue
        else:  # a byte of the archive's own bookkeeping, such as a time stamp
            same += 1
            assert np.array_equal(back.p_WRs, heap.p_WRs)
    assert same < 20


def test_foreign_truncated_missing_and_newer_files_are_refused(heap, tmp_path):
    path = tmp_path / "pile.npz"
    with pytest.raises(InputError, match="no such file"):
        load_pile(path)
    path.write_text("hello")
    with pytest.raises(InputError, match="not a readable drakerock-pile file"):
        load_pile(path)
    np.savez(path.with_name("other.npz"), a=np.zeros(3))
    with pytest.raises(InputError, match="not a drakerock-pile file"):
        load_pile(tmp_path / "other.npz")
    save_pile(heap, path)
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(InputError, match=r"pile\.npz"):
        load_pile(path)


def test_wrong_shapes_and_nan_are_refused(heap):
    with pytest.raises(ValueError, match="q_WRs"):
        replace(heap, q_WRs=np.zeros((3, 4)))
    with pytest.raises(ValueError, match="not finite"):
        replace(heap, p_WRs=np.full((12, 3), np.nan))


def test_select_and_join_are_inverse(heap):
    mask = np.arange(12) % 3 == 0
    joined = heap.select(mask).join(heap.select(~mask))
    order = np.argsort(np.concatenate([np.flatnonzero(mask), np.flatnonzero(~mask)]))
    assert np.array_equal(joined.p_WRs[order], heap.p_WRs)
    assert isinstance(joined, PileState)


def test_a_rock_that_loses_a_contact_no_longer_rests(heap):
    contacts = ContactMemory(
        np.array([[0, 1], [1, 2], [3, -1]]), np.zeros((3, 3)), np.ones((3, 3)), np.ones(len(heap), bool)
    )
    pile = replace(heap, contacts=contacts)
    kept = np.arange(len(heap)) != 1
    rest = pile.select(kept).contacts
    assert np.array_equal(rest.pairs, [[2, -1]])  # rock 3 on the site, renumbered
    assert list(np.flatnonzero(~rest.resting)) == [0, 1]  # rocks 0 and 2 leant on rock 1


def make_contacts():
    rng = np.random.default_rng(4)
    pairs = np.array([[0, 1], [0, 3], [2, 5], [4, -9], [1, -9]])
    return ContactMemory(pairs, rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), np.arange(12) % 2 == 0)


def test_contact_forces_keep_their_bits_through_the_file(heap, tmp_path):
    pile = replace(heap, contacts=make_contacts())
    save_pile(pile, tmp_path / "pile.npz")
    back = load_pile(tmp_path / "pile.npz")
    for name in ("pairs", "points", "impulses", "resting"):
        one, two = getattr(back.contacts, name), getattr(pile.contacts, name)
        assert one.dtype == two.dtype
        assert np.array_equal(one, two), name


def test_contacts_are_renumbered_with_their_rocks(heap):
    pile = replace(heap, contacts=make_contacts())
    some = pile.select(np.array([0, 1, 4]))
    assert some.contacts.pairs.tolist() == [[0, 1], [2, -9], [1, -9]]
    assert np.array_equal(some.contacts.impulses, pile.contacts.impulses[[0, 3, 4]])
    both = heap.join(pile)
    assert both.contacts.pairs[0].tolist() == [12, 13]
    assert both.contacts.pairs[3].tolist() == [16, -9]
    assert both.contacts.resting.sum() == 6


def test_contacts_of_unknown_rocks_are_refused(heap):
    contacts = make_contacts()
    with pytest.raises(ValueError, match="not in the pile"):
        replace(heap, contacts=replace(contacts, pairs=contacts.pairs + 9))
    with pytest.raises(ValueError, match="impulses"):
        replace(heap, contacts=replace(contacts, impulses=np.full((5, 3), np.nan)))


def test_contacts_of_a_reordered_pile_press_the_same_points(heap):
    pile = replace(heap, contacts=make_contacts())
    order = np.random.default_rng(1).permutation(len(heap))
    turned = pile.select(order)
    back = turned.select(np.argsort(order))
    assert np.array_equal(back.p_WRs, pile.p_WRs)

    def find_pressed(pile):
        """Return which rocks each contact is between, where it presses, and how much."""
        first, second = pile.contacts.pairs.T
        R_WRs = Rotation.from_quat(pile.q_WRs[first], scalar_first=True)
        return first, second, pile.p_WRs[first] + R_WRs.apply(pile.contacts.points), pile.contacts.impulses

    first, second, places, impulses = find_pressed(turned)
    assert ((second < 0) | (first < second)).all()
    assert (np.diff(first) >= 0).all()
    old = {(a, b): (p, i) for a, b, p, i in zip(*find_pressed(pile), strict=True)}
    for a, b, place, impulse in zip(first, second, places, impulses, strict=True):
        one, two = order[a], order[b] if b >= 0 else b
        sign = 1.0 if (one, two) in old else -1.0
        place_before, impulse_before = old[(one, two) if sign > 0.0 else (two, one)]
        assert place == pytest.approx(place_before, abs=1e-6)
        assert np.array_equal(impulse, sign * impulse_before)
    assert (second >= 0).sum() == 3
    assert np.array_equal(turned.contacts.resting, pile.contacts.resting[order])
