"""Model reduction: rocks that come to rest, and what wakes them.

A resting rock stays in the force network: the impulses of its contacts are kept, contacts with awake
neighbours are solved against it as against solid ground. It is woken by a change of its load, or by the refinement
sensor in front of the bucket.

Rocks that lean on one that moves (a mover) are a case of their own. Single rocks that rest in a slope that slides
slowly are posts that brake it, and what a mover does to its neighbours goes on in one direction, while changes
elsewhere are the force network's unrest. So they do not rest, and a smaller change wakes them.

Many changes, each too small to wake a rock, may add up to a slope that would slide. So from time to time all that have
moved are woken together.
"""

from __future__ import annotations

import numpy as np

from drakerock.rocks.engine.collision.broad_phase import AWAKE, CALM, COMOVING, LOST, RESTING, SEARCHED
from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.contacts import MEMORY_IMPULSE, Memory, is_loaded, sum_pressures

# Columns of a rock's bookkeeping (all stored in the context).
STATUS = 0
# of an awake rock
STILL_TIME = 1
ANCHOR = 2  # 2..4 where the rock was when its time at rest began
# of a resting rock
CHANGED_STEPS = 1
REFERENCE = 2  # 2..4 sum of its contact impulses when it came to rest [N s]
# of both
MOVED = 5  # 1: it has moved since the start
WAY = 6  # how far it has moved since its contacts were searched, its turning included [m]
BOOK_WIDTH = 7

# In CHANGED_STEPS: the rock has just come to rest, its reference is not set yet.
NEW = -1.0


@kernel
def is_sensed(x: float, y: float, z: float, radius: float, sensors: Array) -> bool:
    """Return whether a sphere meets one of the boxes (k, 18): rotation by rows, position, lower, upper."""
    for s in range(len(sensors)):
        box = sensors[s]
        dx, dy, dz = x - box[9], y - box[10], z - box[11]
        d = 0
        while d < 3:
            local = box[d] * dx + box[3 + d] * dy + box[6 + d] * dz
            if local < box[12 + d] - radius or local > box[15 + d] + radius:
                break
            d += 1
        if d == 3:
            return True
    return False


@kernel
def mark_by_movers(
    book: Array,
    velocities: Array,
    memory: Memory,
    n_idle: int,
    mover_speed: float,
    movers: Array,
    marks: Array,
) -> None:
    """Mark the rocks that share a loaded contact with a mover.

    Args:
        book: (n, BOOK_WIDTH).
        velocities: (n, 6).
        memory, n_idle: loaded contact points, see `contacts`; the first so many are of rocks at rest.
        mover_speed: awake rocks that are faster are movers [m/s].
        movers: (n,) bool, set.
        marks: (n,) bool, set: the rocks that lean on one.
    """
    n = len(book)
    marks[:] = False
    for i in range(n):
        movers[i] = _moves(book, velocities, i, mover_speed)
    for row in range(n_idle, len(memory.pairs)):
        a, b = memory.pairs[row, 0], memory.pairs[row, 1]
        if b < n and (movers[a] or movers[b]) and is_loaded(memory, row):
            marks[a] |= movers[b]
            marks[b] |= movers[a]


@kernel
def _moves(book: Array, velocities: Array, i: int, speed: float) -> bool:
    if book[i, STATUS] != AWAKE:
        return False
    x, y, z = velocities[i, 3], velocities[i, 4], velocities[i, 5]
    return bool(x * x + y * y + z * z > speed * speed)


@kernel
def mark_calm(
    book: Array,
    positions: Array,
    velocities: Array,
    radius: Array,
    sensors: Array,
    time_step: float,
    slow_speed: float,
    distance: float,
    search_fast: bool,
    calm: Array,
) -> None:
    """Mark the rocks whose contacts need no search in this step: slow ones, and those that do not move at all.

    All contacts are searched of rocks that are just woken, as what they touch may have moved meanwhile, and of those in
    the sensor, which the bucket may strike in the next step.

    Args:
        book: (n, BOOK_WIDTH), changed: the way of each rock.
        positions, velocities, radius, sensors: see `wake` and `is_sensed`.
        time_step: [s].
        slow_speed: below it rocks are slow, their turning at their bounding spheres included [m/s].
        distance: slow rocks are searched when they will have moved this far since the last time [m]; below 0: always.
        search_fast: whether the others, which else are COMOVING, are searched too.
        calm: (n,) at least, set: CALM, COMOVING or SEARCHED.
    """
    for i in range(len(book)):
        calm[i] = SEARCHED if book[i, STATUS] == LOST else CALM
        if book[i, STATUS] != AWAKE:
            continue
        v = velocities[i]
        spin = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        speed = np.sqrt(v[3] * v[3] + v[4] * v[4] + v[5] * v[5]) + radius[i] * spin
        book[i, WAY] += time_step * speed
        slow = speed < slow_speed
        if (
            (search_fast and not slow)
            or (slow and book[i, WAY] + time_step * speed > distance)
            or book[i, WAY] == np.inf
            or is_sensed(positions[i, 0], positions[i, 1], positions[i, 2], radius[i], sensors)
        ):
            calm[i] = SEARCHED
            book[i, WAY] = 0.0
        elif not slow:
            calm[i] = COMOVING


@allocating_kernel
def wake(
    book: Array,
    positions: Array,
    radius: Array,
    mass: Array,
    memory: Memory,
    n_idle: int,
    sensors: Array,
    by_movers: Array,
    load: float,
    share: float,
    near: float,
    steps: int,
) -> int:
    """Wake resting rocks.

    A rock under pressure from all sides holds what a loose one on the slope would not, and its neighbours' forces are
    never still: what wakes it is measured by that pressure, or else most of those woken do not move.

    Args:
        book: (n, BOOK_WIDTH) changed.
        positions: (n, 3).
        radius: (n,) bounding spheres [m].
        mass: (n,) [kg].
        memory, n_idle: see `mark_by_movers`.
        sensors: (k, 18) see `is_sensed`.
        by_movers: (n,) see `mark_by_movers`.
        load: change of the impulses' sum per mass above which a rock wakes, if it is above ... [m/s]
        share: ... this multiple of half the sum of their sizes, the pressure, too.
        near: both are multiplied by this for rocks that lean on a mover.
        steps: for how many steps on end.

    Returns:
        number of rocks woken.
    """
    n = len(book)
    sums, touched = np.zeros((n, 3)), np.zeros(n, np.bool_)
    _sum_where_touched(book, memory, n_idle, touched, sums)
    changed, pressures = np.zeros(n, np.bool_), np.empty(n)
    change2 = np.empty(n)
    for i in range(n):
        if book[i, STATUS] == RESTING:
            if book[i, CHANGED_STEPS] == NEW:
                book[i, CHANGED_STEPS] = 0.0
                for d in range(3):
                    book[i, REFERENCE + d] = sums[i, d]
            change2[i] = 0.0
            if not touched[i]:
                continue
            for d in range(3):
                change2[i] += (sums[i, d] - book[i, REFERENCE + d]) ** 2
            limit = load * mass[i] * (near if by_movers[i] else 1.0)
            changed[i] = change2[i] > limit * limit
    if changed.any():
        sum_pressures(memory, n, changed, pressures)
    n_woken = 0
    for i in range(n):
        if book[i, STATUS] != RESTING:
            continue
        limit = share * pressures[i] * (near if by_movers[i] else 1.0)
        if changed[i] and change2[i] > limit * limit:
            book[i, CHANGED_STEPS] += 1.0
        else:
            book[i, CHANGED_STEPS] = 0.0
        if book[i, CHANGED_STEPS] >= steps or is_sensed(
            positions[i, 0], positions[i, 1], positions[i, 2], radius[i], sensors
        ):
            wake_rock(book, positions, i)
            n_woken += 1
    return n_woken


@kernel
def _sum_where_touched(book: Array, memory: Memory, n_idle: int, touched: Array, sums: Array) -> None:
    """Sum the contact impulses of the rocks that were solved, or touched one that was; others' have not changed.

    Args:
        book, memory, n_idle: see `wake`.
        touched: (n,) bool, False before; set.
        sums: (n, 3) zero before; added to for the rocks that are touched [N s].
    """
    n = len(book)
    for row in range(n_idle, len(memory.pairs)):
        a, b = memory.pairs[row, 0], memory.pairs[row, 1]
        touched[a] = True
        if b < n:
            touched[b] = True
    for row in range(len(memory.pairs)):
        a, b = memory.pairs[row, 0], memory.pairs[row, 1]
        if a < 0 or (not touched[a] and (b >= n or not touched[b])):
            continue
        # What has left the site carries no more.
        if book[a, STATUS] == LOST or (b < n and book[b, STATUS] == LOST):
            continue
        for d in range(3):
            sums[a, d] -= memory.values[row, MEMORY_IMPULSE + d]
        if b < n:
            for d in range(3):
                sums[b, d] += memory.values[row, MEMORY_IMPULSE + d]


@kernel
def wake_rock(book: Array, positions: Array, i: int) -> None:
    """Make one rock awake."""
    book[i, STATUS] = AWAKE
    book[i, STILL_TIME] = 0.0
    book[i, WAY] = np.inf
    for d in range(3):
        book[i, ANCHOR + d] = positions[i, d]


@kernel
def wake_all(book: Array, positions: Array, only_moved: bool) -> int:
    """Wake all resting rocks, or those of them that have moved since the start; return their number."""
    n_woken = 0
    for i in range(len(book)):
        if book[i, STATUS] == RESTING and (book[i, MOVED] == 1.0 or not only_moved):
            wake_rock(book, positions, i)
            n_woken += 1
    return n_woken


@kernel
def rest(
    book: Array,
    positions: Array,
    velocities: Array,
    radius: Array,
    sensors: Array,
    by_movers: Array,
    time_step: float,
    displacement: float,
    time: float,
    speed: float,
    lower: Array,
    upper: Array,
    may_rest: bool,
) -> tuple[int, int]:
    """Let awake rocks come to rest, and take those that left the site out.

    Args:
        book, positions, radius, sensors, by_movers: as for `wake`.
        velocities: (n, 6) changed: zero for rocks that come to rest.
        time_step: [s].
        displacement, time, speed: see `RestConfig`.
        lower, upper: (3,) the site's box; a rock outside is lost [m].
        may_rest: False: only lost rocks are looked for.

    Returns:
        number of rocks that came to rest (their reference is set by the next `wake`), number lost.
    """
    n_rested, n_lost = 0, 0
    for i in range(len(book)):
        if book[i, STATUS] != AWAKE:
            continue
        moved2 = 0.0
        fastest = 0.0
        outside = False
        for d in range(3):
            moved2 += (positions[i, d] - book[i, ANCHOR + d]) ** 2
            fastest = max(fastest, max(abs(velocities[i, d]), abs(velocities[i, 3 + d])))
            if positions[i, d] < lower[d] or positions[i, d] > upper[d]:
                outside = True
        if outside:
            book[i, STATUS] = LOST
            for d in range(6):
                velocities[i, d] = 0.0
            n_lost += 1
            continue
        if not may_rest:
            continue
        if moved2 > displacement * displacement:
            book[i, STILL_TIME] = 0.0
            book[i, MOVED] = 1.0
            for d in range(3):
                book[i, ANCHOR + d] = positions[i, d]
        else:
            book[i, STILL_TIME] += time_step
        if (
            book[i, STILL_TIME] >= time
            and fastest < speed
            and not by_movers[i]
            and not is_sensed(positions[i, 0], positions[i, 1], positions[i, 2], radius[i], sensors)
        ):
            book[i, STATUS] = RESTING
            book[i, CHANGED_STEPS] = NEW
            for d in range(6):
                velocities[i, d] = 0.0
            n_rested += 1
    return n_rested, n_lost
