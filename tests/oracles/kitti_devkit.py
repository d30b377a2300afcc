"""KITTI's object evaluation by its rules: frame by frame, threshold by threshold."""

import math

from oracles import clipping

HEIGHTS, OCCLUSIONS, TRUNCATIONS = (40, 25, 25), (0, 1, 2), (0.15, 0.3, 0.5)
NEIGHBOURS = {"Car": "Van", "Pedestrian": "Person_sitting"}


class Kitti:
    """KITTI's rules on what counts."""

    def __init__(self, difficulty):
        self.difficulty = difficulty

    def label_state(self, label, category):
        """Return whether a label is counted, ignored or absent."""
        return label_state(label, category, self.difficulty)

    def result_state(self, result, category):
        """Return whether a result is counted, ignored or absent."""
        return result_state(result, category, self.difficulty)

    def is_spared(self, result):
        """Return whether a result is no false positive if it matches nothing."""
        return False


class ByPoints(Kitti):
    """Levels by the LiDAR points in a label, which has them in the key "points"."""

    def __init__(self, least):
        self.least = least

    def label_state(self, label, category):
        """A label with too few points, or a neighbour, is ignored."""
        if label["category"] == NEIGHBOURS.get(category):
            return "ignored"
        if label["category"] != category:
            return "absent"
        return "counted" if label["points"] >= self.least else "ignored"

    def result_state(self, result, category):
        """Every result of the category counts."""
        return "counted" if result["category"] == category else "absent"


class ByDistance(ByPoints):
    """Ranges of distance: a result beyond the range can match, but is no false positive."""

    def __init__(self, low, high):
        super().__init__(1)
        self.low, self.high = low, high

    def is_inside(self, item):
        """Return whether a box is in the range."""
        x, _, z = item["location"]
        return self.low <= math.sqrt(x * x + z * z) < self.high

    def label_state(self, label, category):
        """A label beyond the range is ignored."""
        return super().label_state({**label, "points": int(self.is_inside(label))}, category)

    def is_spared(self, result):
        """Return whether the result is beyond the range."""
        return not self.is_inside(result)


def average_precision(labels, results, category, figure, difficulty, min_overlap):
    """Return (R11, R40) in percent; labels and results are lists of dicts, one list per frame.

    `difficulty` is an index of KITTI's levels, or rules such as `ByPoints`.
    """
    metric = "image" if figure == "aos" else figure
    frames = [
        Frame(label, result, category, metric, difficulty, min_overlap)
        for label, result in zip(labels, results, strict=True)
    ]
    count = sum(frame.states.count("counted") for frame in frames)
    found = sorted((score for frame in frames for score in frame.scores_found()), reverse=True)
    values = []
    for threshold in sampled(found, count):
        hits, false, similarity = map(sum, zip(*(f.tally(threshold) for f in frames), strict=True))
        values.append((similarity if figure == "aos" else hits) / max(hits + false, 1))
    curve = [max(values[position:], default=0.0) for position in range(41)]
    return 100 * sum(curve[::4]) / 11, 100 * sum(curve[1:]) / 40


def sampled(scores, count):
    """Return the scores nearest to each 1/40 of recall; `scores` descend."""
    thresholds, recall = [], 0.0
    for number, score in enumerate(scores, start=1):
        left = number / count
        right = (number + 1) / count if number < len(scores) else left
        if right - recall < recall - left and number < len(scores):
            continue
        thresholds.append(score)
        recall += 1 / 40
    return thresholds


class Frame:
    """One frame for one category, metric and difficulty."""

    def __init__(self, labels, results, category, metric, difficulty, min_overlap):
        self.labels, self.results = labels, results
        self.rules = Kitti(difficulty) if isinstance(difficulty, int) else difficulty
        self.states = [self.rules.label_state(label, category) for label in labels]
        self.result_states = [self.rules.result_state(result, category) for result in results]
        self.overlap, self.min_overlap = OVERLAPS[metric], min_overlap
        self.regions = [label for label in labels if label["category"] == "DontCare"]
        if metric != "image":
            self.regions = []

    def pairs(self, label, free):
        """Return (result index, overlap) of the free results that overlap enough."""
        for index, result in enumerate(self.results):
            if index in free and self.result_states[index] != "absent":
                overlap = self.overlap(label, result)
                if overlap > self.min_overlap:
                    yield index, overlap

    def scores_found(self):
        """Return scores of true positives when each object takes the highest score."""
        free, scores = set(range(len(self.results))), []
        for label, state in zip(self.labels, self.states, strict=True):
            options = [index for index, _ in self.pairs(label, free)] if state != "absent" else []
            if options:
                best = max(options, key=lambda index: (self.results[index]["score"], -index))
                free.discard(best)
                if state == self.result_states[best] == "counted":
                    scores.append(self.results[best]["score"])
        return scores

    def tally(self, threshold):
        """Return (tp, fp, similarity) when each object takes the greatest overlap."""
        free = {i for i, result in enumerate(self.results) if result["score"] >= threshold}
        hits, similarity = 0, 0.0
        for label, state in zip(self.labels, self.states, strict=True):
            options = list(self.pairs(label, free)) if state != "absent" else []
            counted = [pair for pair in options if self.result_states[pair[0]] == "counted"]
            if not options:
                continue
            best = max(counted, key=lambda pair: (pair[1], -pair[0]))[0] if counted else None
            best = options[0][0] if best is None else best
            free.discard(best)
            if state == self.result_states[best] == "counted":
                hits += 1
                turn = label["alpha"] - self.results[best]["alpha"]
                similarity += (1 + math.cos(turn)) / 2
        false = [i for i in free if self.result_states[i] == "counted" and not self.in_dontcare(i)]
        return hits, len(false), similarity

    def in_dontcare(self, index):
        """Return whether a detection is no false positive: spared, or in a DontCare region."""
        if self.rules.is_spared(self.results[index]):
            return True
        box = self.results[index]["box_2d"]
        area = (box[2] - box[0]) * (box[3] - box[1])
        return any(
            common_area(region["box_2d"], box) > self.min_overlap * area for region in self.regions
        )


def label_state(label, category, difficulty):
    """Return whether a label is counted, ignored or absent."""
    if label["category"] == NEIGHBOURS.get(category):
        return "ignored"
    if label["category"] != category:
        return "absent"
    hard = (
        label["occluded"] > OCCLUSIONS[difficulty]
        or label["truncated"] > TRUNCATIONS[difficulty]
        or label["box_2d"][3] - label["box_2d"][1] <= HEIGHTS[difficulty]
    )
    return "ignored" if hard else "counted"


def result_state(result, category, difficulty):
    """Return whether a result is counted, ignored or absent."""
    if result["box_2d"][3] - result["box_2d"][1] < HEIGHTS[difficulty]:
        return "ignored"
    return "counted" if result["category"] == category else "absent"


def common_area(a, b):
    """Return the common area of two rectangles."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0) * max(height, 0)


def image_iou(a, b):
    """Return the IoU of the 2D boxes."""
    a, b = a["box_2d"], b["box_2d"]
    common = common_area(a, b)
    return common / (sum((c[2] - c[0]) * (c[3] - c[1]) for c in (a, b)) - common)


def lidar_like(item):
    """Return the box by its centre, with x forward, y left, z up."""
    x, y, z = item["location"]
    height, width, length = item["dimensions"]
    return z, -x, height / 2 - y, length, width, height, -item["rotation_y"] - math.pi / 2


OVERLAPS = {
    "image": image_iou,
    "bev": lambda a, b: clipping.bev_iou(lidar_like(a), lidar_like(b)),
    "3d": lambda a, b: clipping.iou_3d(lidar_like(a), lidar_like(b)),
}
