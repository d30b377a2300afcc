"""Tracks of objects through a sequence: a Kalman filter and one-to-one assignment.

Source: Weng et al., "3D Multi-Object Tracking: A Baseline and New Evaluation Metrics" (AB3DMOT),
IROS 2020, with the motion model on the ground plane. An object has a position p and a velocity v
that is constant except for random accelerations. Each axis of the plane has the same noise, so one
2 x 2 covariance per object serves both:

    predict over dt   p += v dt,  P_pp += 2 dt P_pv + dt^2 P_vv + q dt^3 / 3,
                      P_pv += dt P_vv + q dt^2 / 2,  P_vv += q dt
    update with z     K = P / (P_pp + r),  p += K_p (z - p),  v += K_v (z - p)

where q and r are the variances of the accelerations and of a box's centre. Noise is measured in
lengths of the object, so that a pedestrian has a smaller gate than a truck without a table of
categories. The filter runs forward and backward in time. A link between two
boxes counts if both runs made it, or if one made it and the other linked neither box elsewhere; so
the tracks of a reversed sequence are the same.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from curate.shapes import Float, Int

MAX_GAP_S = 1.0
"""Longest time between two boxes that are linked directly."""
# 99 % of the boxes of an object are within this squared distance from its prediction, in standard
# deviations (chi square with 2 degrees of freedom).
_GATE = 9.21
# A box of clutter per this area in m2: a link must be more likely than that the box is clutter.
_CLUTTER_AREA = 2500.0
# Standard deviation of an object's speed before it is observed, in lengths per second: 10 m/s for a
# car, 2 m/s for a pedestrian.
_UNSEEN_SPEED = 2.5
# Standard deviation of the sensor's own speed where its poses are unknown, in m/s.
_SENSOR_SPEED = 10.0
# Standard deviation of the change of speed within a second, in lengths per second.
_ACCELERATION = 0.75
# Standard deviation of a box's centre: metres, and share of its length.
_CENTRE_NOISE = (0.1, 0.05)


@dataclass(frozen=True)
class Sightings:
    """The boxes of one category in a sequence, in any order.

    Attributes:
        steps: (n,) index of each box's frame in `times`.
        positions: (n, 2) centres on the ground plane, in metres.
        lengths: (n,) lengths of the boxes, in metres.
        times: (T,) times of all frames in seconds, ascending.
        fixed: whether positions are in a frame of reference that does not move with the sensor.
    """

    steps: Int[np.ndarray, " n"]
    positions: Float[np.ndarray, "n 2"]
    lengths: Float[np.ndarray, " n"]
    times: Float[np.ndarray, " T"]
    fixed: bool


def track_numbers(sightings: Sightings) -> Int[np.ndarray, " n"]:
    """Return the (n,) number of each box's track; a box of no other track is one by itself."""
    count = len(sightings.steps)
    forward = _predecessors(sightings)
    backward = _predecessors(_reversed(sightings))
    later, earlier = _agreed(forward, backward)
    links = coo_array((np.ones(len(later)), (later, earlier)), shape=(count, count))
    _, numbers = connected_components(links, directed=False)
    return np.asarray(numbers, dtype=np.int64)


def _reversed(sightings: Sightings) -> Sightings:
    last = len(sightings.times) - 1
    return Sightings(
        last - sightings.steps,
        sightings.positions,
        sightings.lengths,
        -sightings.times[::-1],
        sightings.fixed,
    )


def _agreed(forward: np.ndarray, backward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the later and the earlier box of each link that the two runs do not contradict.

    Args:
        forward: (n,) the box before each box, -1 for none, of the run forward in time.
        backward: (n,) the box after each box, -1 for none, of the run backward in time.
    """
    after_in_forward, before_in_backward = _inverted(forward), _inverted(backward)
    one = np.flatnonzero(forward >= 0)  # the later box of each link
    before = forward[one]
    same = backward[before] == one
    kept = same | ((backward[before] < 0) & (before_in_backward[one] < 0))
    other = np.flatnonzero(backward >= 0)  # the earlier box of each link
    after = backward[other]
    added = (after_in_forward[other] < 0) & (forward[after] < 0)
    return (
        np.concatenate([one[kept], after[added]]),
        np.concatenate([before[kept], other[added]]),
    )


def _inverted(links: np.ndarray) -> np.ndarray:
    """Return, for each box, the box that links to it, -1 for none."""
    found = np.full(len(links), -1)
    linked = np.flatnonzero(links >= 0)
    found[links[linked]] = linked
    return found


def _predecessors(sightings: Sightings) -> np.ndarray:
    """Return the (n,) box before each box in one run over the frames; -1 for none."""
    order = np.lexsort((sightings.lengths, *sightings.positions.T, sightings.steps))
    bounds = np.searchsorted(sightings.steps[order], np.arange(len(sightings.times) + 1))
    tracker = _Tracker(sightings)
    found = np.full(len(order), -1)
    for step in np.flatnonzero(np.diff(bounds)):
        boxes = order[bounds[step] : bounds[step + 1]]
        found[boxes] = tracker.advance(float(sightings.times[step]), boxes)
    return found


class _Tracker:
    """The state of all tracks that may continue, one row per track.

    Attributes:
        last: the track's last box.
        seen: time of this box.
        position: predicted position.
        velocity: estimated velocity.
        covariance: rows P_pp, P_pv, P_vv.
    """

    def __init__(self, sightings: Sightings) -> None:
        self._positions, self._lengths = sightings.positions, sightings.lengths
        self._noise = (_CENTRE_NOISE[0] + _CENTRE_NOISE[1] * sightings.lengths) ** 2
        sensor = 0.0 if sightings.fixed else _SENSOR_SPEED
        self._unseen = (_UNSEEN_SPEED * sightings.lengths) ** 2 + sensor**2
        self._agitation = (_ACCELERATION * sightings.lengths) ** 2
        self.time = -np.inf
        self.last = np.zeros(0, dtype=np.int64)
        self.seen = np.zeros(0)
        self.position, self.velocity = np.zeros((0, 2)), np.zeros((0, 2))
        self.covariance = np.zeros((3, 0))

    def advance(self, time: float, boxes: np.ndarray) -> np.ndarray:
        """Go to the next frame; return the box before each of its boxes, -1 for none."""
        self._predict(time)
        tracks, matched = self._assign(boxes)
        before = np.full(len(boxes), -1)
        before[matched] = self.last[tracks]
        self._update(tracks, boxes[matched])
        self._start(np.delete(boxes, matched))
        return before

    def _keep(self, rows: np.ndarray) -> None:
        self.last, self.seen = self.last[rows], self.seen[rows]
        self.position, self.velocity = self.position[rows], self.velocity[rows]
        self.covariance = self.covariance[:, rows]

    def _predict(self, time: float) -> None:
        """Drop the tracks that ended, and move the others to the time of the frame."""
        self._keep(time - self.seen <= MAX_GAP_S + 1e-6)
        dt, self.time = time - self.time, time
        if not len(self.last):
            return
        agitation = self._agitation[self.last]
        pp, pv, vv = self.covariance
        self.position = self.position + dt * self.velocity
        self.covariance = np.stack(
            [
                pp + 2 * dt * pv + dt**2 * vv + agitation * dt**3 / 3,
                pv + dt * vv + agitation * dt**2 / 2,
                vv + agitation * dt,
            ]
        )

    def _assign(self, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of matched tracks, and of their boxes among the frame's boxes.

        The total log-likelihood against "each box is clutter" is maximal. For one pair it is,
        times -2 and with d the distance in standard deviations: d^2 + 2 ln(2 pi variance / area).
        """
        variance = self.covariance[0][:, None] + self._noise[boxes]
        offsets = self.position[:, None] - self._positions[boxes]
        distance = np.einsum("ijk,ijk->ij", offsets, offsets) / variance
        cost = distance + 2 * np.log(2 * np.pi * variance / _CLUTTER_AREA)
        possible = (distance < _GATE) & (cost < 0)
        rows, columns = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
        near = np.ix_(rows, columns)
        one, other = linear_sum_assignment(np.where(possible[near], cost[near], 0.0))
        matched = possible[near][one, other]
        return rows[one[matched]], columns[other[matched]]

    def _update(self, tracks: np.ndarray, boxes: np.ndarray) -> None:
        """Correct the matched tracks by their boxes."""
        pp, pv, vv = self.covariance[:, tracks]
        spread = pp + self._noise[boxes]
        for_position, for_velocity = pp / spread, pv / spread
        offset = self._positions[boxes] - self.position[tracks]
        self.position[tracks] += for_position[:, None] * offset
        self.velocity[tracks] += for_velocity[:, None] * offset
        self.covariance[:, tracks] = (
            (1 - for_position) * pp,
            (1 - for_position) * pv,
            vv - for_velocity * pv,
        )
        self.last[tracks], self.seen[tracks] = boxes, self.time

    def _start(self, boxes: np.ndarray) -> None:
        """Begin a track with each box that no track claims."""
        self.last = np.concatenate([self.last, boxes])
        self.seen = np.concatenate([self.seen, np.full(len(boxes), self.time)])
        self.position = np.concatenate([self.position, self._positions[boxes]])
        self.velocity = np.concatenate([self.velocity, np.zeros((len(boxes), 2))])
        fresh = np.stack([self._noise[boxes], np.zeros(len(boxes)), self._unseen[boxes]])
        self.covariance = np.concatenate([self.covariance, fresh], axis=1)
