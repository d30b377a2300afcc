"""Meshes of cars, pedestrians and cyclists in many sizes, shapes and poses.

All face along +x and stand on z = 0. Sizes follow the distribution of KITTI's labels (a car is
3.9 +- 0.4 m long, a pedestrian 1.75 +- 0.1 m tall, a cyclist 1.75 +- 0.15 m long).
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from curate.simulation.materials import Material
from curate.simulation.meshes import Mesh, box, cylinder, ellipsoid, frustum, merge, ring

VARIANTS = {"Car": 48, "Pedestrian": 64, "Cyclist": 48}
"""Number of different meshes of each category."""

# length, width, height, bonnet / length, boot / length, cabin top / bottom length, belt line /
# height
_CAR_STYLES = np.array(
    [
        (4.35, 1.75, 1.46, 0.27, 0.17, 0.52, 0.58),  # saloon
        (4.00, 1.70, 1.48, 0.25, 0.03, 0.68, 0.58),  # hatchback
        (4.55, 1.76, 1.50, 0.25, 0.02, 0.76, 0.58),  # estate
        (4.40, 1.82, 1.70, 0.25, 0.02, 0.76, 0.58),  # off-road
        (3.50, 1.60, 1.50, 0.20, 0.02, 0.70, 0.56),  # small
        (4.25, 1.78, 1.34, 0.31, 0.14, 0.45, 0.60),  # coupe
        (4.30, 1.78, 1.64, 0.17, 0.02, 0.74, 0.56),  # people carrier
    ]
)


@cache
def actor_mesh(category: str, variant: int) -> Mesh:
    """Return mesh number `variant` of a category; it is the same in every process."""
    generator = np.random.default_rng([list(_BUILDERS).index(category), variant])
    return _BUILDERS[category](generator).standing_on_origin()


def actor_colours(category: str, generator: np.random.Generator) -> dict[Material, np.ndarray]:
    """Return random colours of the paint or the clothes of one actor."""
    if category == "Car":
        return {Material.PAINT: _paint(generator), Material.TRIM: np.full(3, 0.1)}
    colours = {
        Material.UPPER_CLOTH: _cloth(generator),
        Material.LOWER_CLOTH: _cloth(generator) * 0.7,
        Material.SKIN: np.array([0.78, 0.58, 0.46]) * generator.uniform(0.45, 1.1),
        Material.HAIR: np.array([0.35, 0.24, 0.15]) * generator.uniform(0.2, 1.6),
        Material.SHOE: np.full(3, generator.uniform(0.05, 0.6)),
    }
    if category == "Cyclist":
        colours[Material.METAL] = _paint(generator)
        colours[Material.HAIR] = _paint(generator)  # a helmet
    return colours


def _paint(generator: np.random.Generator) -> np.ndarray:
    """Return (3,) RGB: in most cases grey, otherwise a saturated colour."""
    if generator.random() < 0.65:
        return np.full(3, generator.choice([0.06, 0.12, 0.3, 0.5, 0.65, 0.85]))
    colours = [(0.55, 0.05, 0.06), (0.06, 0.13, 0.42), (0.1, 0.3, 0.5), (0.1, 0.25, 0.13)]
    colours += [(0.75, 0.65, 0.12), (0.38, 0.24, 0.14), (0.7, 0.35, 0.1)]
    return np.array(colours[generator.integers(len(colours))]) * generator.uniform(0.8, 1.2)


def _cloth(generator: np.random.Generator) -> np.ndarray:
    """Return (3,) RGB: a random grey, blended with a random colour."""
    grey = np.full(3, generator.uniform(0.08, 0.8))
    tint = generator.uniform(0.05, 0.85, size=3)
    return np.asarray(grey + (tint - grey) * generator.choice([0.05, 0.2, 0.8]))


def _car(generator: np.random.Generator) -> Mesh:
    """Return a body, a cabin with windows, four wheels, lights and number plates."""
    style = _CAR_STYLES[generator.integers(len(_CAR_STYLES))]
    length, width, height = style[:3] * generator.normal(1.0, (0.04, 0.025, 0.025))
    bonnet, boot, top, belt = style[3:] * generator.uniform(0.92, 1.08, size=4)
    sill, wheel = 0.19, generator.uniform(0.29, 0.34)
    belt_z = belt * height
    parts = [
        frustum(
            (0, 0, (sill + belt_z) / 2),
            (length, width, belt_z - sill),
            (generator.uniform(0.93, 0.97), 0.95),
            Material.PAINT,
        ),
        box((0, 0, sill + 0.06), (length + 0.02, width * 0.98, 0.16), Material.TRIM),
    ]
    parts += _car_cabin(length, width, height, belt_z, bonnet, boot, top)
    for x in (0.32 * length, -0.31 * length):
        for side in (-1, 1):
            outer = side * width / 2
            start, end = (x, outer * 0.8, wheel), (x, outer * 1.005, wheel)
            parts.append(cylinder(start, end, wheel, Material.RUBBER, sides=10))
            hub = (x, outer * 1.015, wheel)
            parts.append(cylinder(end, hub, 0.6 * wheel, Material.METAL, sides=6))
    return merge(parts + _car_lights(length, width, belt_z))


def _car_cabin(
    length: float,
    width: float,
    height: float,
    belt_z: float,
    bonnet: float,
    boot: float,
    top: float,
) -> list[Mesh]:
    """Return the glass from the belt line to the roof, the roof, and the pillars."""
    front, rear = length * (0.5 - bonnet), length * (boot - 0.5)
    bottom = front - rear
    shift = -(bottom * (1 - top) * (0.14 if boot < 0.08 else 0.05))
    centre, roof_z = (front + rear) / 2, height - 0.07
    glass = frustum(
        (centre, 0, (belt_z + roof_z) / 2 - 0.01),
        (bottom, width * 0.93, roof_z - belt_z + 0.02),
        (top, 0.80),
        Material.GLASS,
        top_shift=shift,
    )
    roof = frustum(
        (centre + shift, 0, height - 0.04),
        (bottom * top * 1.02, width * 0.76, 0.08),
        (0.9, 0.9),
        Material.PAINT,
    )
    # Pillars between the side windows, slightly in front of the glass.
    pillars = [
        frustum(
            (centre + share * bottom, 0, (belt_z + roof_z) / 2),
            (0.09, width * 0.945, roof_z - belt_z),
            (1.0, 0.80),
            Material.PAINT,
            top_shift=shift - share * bottom * (1 - top),
        )
        for share in (-0.42, 0.02, 0.44)
    ]
    return [glass, roof, *pillars]


def _car_lights(length: float, width: float, belt_z: float) -> list[Mesh]:
    """Return headlights, rear lights and number plates."""
    parts = []
    for side in (-0.38, 0.38):
        height = belt_z * 0.78
        front, rear = (length / 2 - 0.06, side * width, height), (0.06 - length / 2, side * width)
        parts.append(box(front, (0.12, 0.3, 0.13), Material.HEADLIGHT))
        parts.append(box((*rear, height + 0.04), (0.12, 0.26, 0.16), Material.TAILLIGHT))
    for end in (-1, 1):
        centre = (end * length / 2, 0, 0.42)
        parts.append(box(centre, (0.03, 0.5, 0.11), Material.RETROREFLECTOR))
    return parts


def _pedestrian(generator: np.random.Generator) -> Mesh:
    """Return a walking person, in some variants with a bag, a rucksack or a long coat."""
    height = float(np.clip(generator.normal(1.74, 0.10), 1.4, 2.0))
    if generator.random() < 0.08:
        height *= 0.72  # a child
    hip, shoulder = 0.50 * height, 0.82 * height
    girth = 0.105 * height * generator.uniform(0.9, 1.25)
    stride = generator.choice([0.03, generator.uniform(0.12, 0.26)]) * height
    parts = []
    for side, step in ((-1, stride), (1, -stride)):
        leg = side * 0.055 * height
        ankle = (step, leg, 0.04 * height)
        parts += [
            cylinder(ankle, (0, leg, hip), 0.045 * height, Material.LOWER_CLOTH, end_radius=0.11),
            box((step + 0.05, leg, 0.035), (0.25, 0.09, 0.07), Material.SHOE),
        ]
        parts += _arm(generator, side, shoulder, girth, -step, height)
    torso = (shoulder - hip) * 0.62
    parts += [
        ellipsoid(
            (0, 0, (hip + shoulder) / 2), (girth * 0.75, girth * 1.15, torso), Material.UPPER_CLOTH
        ),
        cylinder((0, 0, shoulder), (0.01, 0, 0.88 * height), 0.055, Material.SKIN, sides=6),
        ellipsoid((0.02, 0, 0.93 * height), (0.095, 0.075, 0.07 * height), Material.SKIN),
        ellipsoid((-0.01, 0, 0.945 * height), (0.1, 0.085, 0.065 * height), Material.HAIR),
    ]
    return merge(parts + _outfit(generator, height, hip, shoulder, girth))


def _arm(
    generator: np.random.Generator,
    side: int,
    shoulder: float,
    girth: float,
    swing: float,
    height: float,
) -> list[Mesh]:
    """Return the upper arm, forearm and hand of one side (-1 right, +1 left)."""
    bend = generator.uniform(0.0, 0.16)
    top = (0, side * girth * 1.05, shoulder - 0.02)
    elbow = (0.35 * swing, side * girth * 1.35, shoulder - 0.18 * height)
    hand = (0.8 * swing + bend, side * girth * 1.3, shoulder - 0.34 * height + bend)
    return [
        cylinder(top, elbow, 0.05, Material.UPPER_CLOTH, sides=6),
        cylinder(elbow, hand, 0.042, Material.UPPER_CLOTH, sides=6),
        ellipsoid(hand, (0.05, 0.04, 0.06), Material.SKIN, sides=6),
    ]


def _outfit(
    generator: np.random.Generator, height: float, hip: float, shoulder: float, girth: float
) -> list[Mesh]:
    """Return nothing, a coat, a rucksack or a carried bag."""
    kind = generator.choice(["none", "coat", "rucksack", "bag"], p=[0.45, 0.25, 0.15, 0.15])
    if kind == "coat":
        low, high = (0, 0, 0.3 * height), (0, 0, shoulder - 0.12)
        return [cylinder(low, high, girth * 1.15, Material.UPPER_CLOTH, end_radius=girth * 0.9)]
    if kind == "rucksack":
        place = (-girth - 0.04, 0, shoulder - 0.2 * height)
        return [box(place, (0.2, 0.3, 0.42), Material.TRIM)]
    if kind == "bag":
        side = generator.choice([-1, 1])
        place = (0, side * (girth * 1.3 + 0.05), hip - 0.12 * height)
        return [box(place, (0.34, 0.12, 0.3), Material.TRIM)]
    return []


def bicycle(generator: np.random.Generator) -> Mesh:
    """Return a bicycle without a rider: wheels, frame, handlebar, saddle."""
    wheel = generator.uniform(0.31, 0.36)
    base = generator.uniform(0.98, 1.12)
    front, rear = (base / 2, 0, wheel), (-base / 2, 0, wheel)
    crank, saddle, head = (-0.06, 0, 0.3), (-0.22, 0, 0.92), (0.36, 0, 0.88)
    tubes = [(rear, crank), (crank, saddle), (crank, head), (saddle, head), (head, front)]
    tubes.append((rear, (-0.2, 0, 0.78)))
    parts = [cylinder(start, end, 0.022, Material.METAL, sides=5) for start, end in tubes]
    parts += [ring(hub, wheel, 0.045, 0.04, Material.RUBBER) for hub in (front, rear)]
    for hub in (front, rear):  # spokes; a disc would occlude too much behind it
        for angle in np.arange(3) * np.pi / 3:
            reach = np.array([np.cos(angle), 0, np.sin(angle)]) * (wheel - 0.04)
            parts.append(
                cylinder(
                    np.array(hub) - reach, np.array(hub) + reach, 0.006, Material.METAL, sides=3
                )
            )
    bar = generator.uniform(0.22, 0.31)
    parts += [
        cylinder((0.33, -bar, 1.02), (0.33, bar, 1.02), 0.018, Material.TRIM, sides=5),
        cylinder(head, (0.33, 0, 1.02), 0.02, Material.METAL, sides=5),
        box((-0.25, 0, 0.95), (0.25, 0.14, 0.06), Material.TRIM),
        box((-base / 2 - 0.1, 0, 0.72), (0.3, 0.16, 0.03), Material.TRIM),
    ]
    return merge(parts)


def _cyclist(generator: np.random.Generator) -> Mesh:
    """Return a bicycle and a rider: bent legs, leaning torso, arms to the handlebar, head."""
    lean = generator.uniform(0.1, 0.42)
    rise = generator.uniform(0.42, 0.52)
    hip = np.array([-0.24, 0.0, 1.0])
    shoulder = hip + np.array([lean, 0, rise])
    head = shoulder + np.array([0.08, 0, generator.uniform(0.16, 0.21)])
    girth = generator.uniform(0.15, 0.19)
    phase = generator.uniform(0, 2 * np.pi)
    parts = [bicycle(generator)]
    for side in (-1, 1):
        turn = phase + (np.pi if side > 0 else 0)
        pedal = np.array([-0.06 + 0.16 * np.cos(turn), side * 0.12, 0.32 + 0.16 * np.sin(turn)])
        knee = (hip + pedal) / 2 + np.array([0.24, side * 0.06, 0.1])
        top = hip + np.array([0, side * 0.09, 0])
        joint = shoulder + np.array([0, side * girth, -0.02])
        grip = np.array([0.31, side * 0.23, 1.03])
        elbow = (joint + grip) / 2 + np.array([-0.06, side * 0.06, -0.06])
        parts += [
            cylinder(top, knee, 0.09, Material.LOWER_CLOTH, end_radius=0.065, sides=6),
            cylinder(knee, pedal, 0.06, Material.LOWER_CLOTH, end_radius=0.045, sides=6),
            box(pedal + np.array([0.05, 0, -0.02]), (0.24, 0.09, 0.07), Material.SHOE),
            cylinder(joint, elbow, 0.052, Material.UPPER_CLOTH, sides=6),
            cylinder(elbow, grip, 0.042, Material.UPPER_CLOTH, sides=6),
            ellipsoid(grip, (0.05, 0.05, 0.05), Material.SKIN, sides=6),
        ]
    parts += [
        cylinder(hip, shoulder, girth * 0.95, Material.UPPER_CLOTH, end_radius=girth * 1.1),
        ellipsoid(hip, (0.16, 0.17, 0.12), Material.LOWER_CLOTH),
        ellipsoid(head, (0.1, 0.08, 0.13), Material.SKIN),
        ellipsoid(head + np.array([-0.02, 0, 0.05]), (0.12, 0.09, 0.1), Material.HAIR),
    ]
    return merge(parts)


_BUILDERS: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "Car": _car,
    "Pedestrian": _pedestrian,
    "Cyclist": _cyclist,
}
