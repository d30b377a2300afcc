"""A small review for tests: two frames, four boxes."""

from curate.review.sheet import Sheet, ShownBox, ShownFrame

CAR = (20.0, 1.0, -0.5, 4.0, 1.8, 1.6, 0.1)
WALKER = (10.0, -2.0, -0.6, 0.8, 0.6, 1.7, -3.1)
CYCLIST = (15.0, 4.0, -0.6, 1.8, 0.6, 1.7, 3.14159)
CATEGORIES = ("Car", "Pedestrian", "Cyclist")


def shown(category: str, box: tuple[float, ...], k: int = 0, **changes) -> ShownBox:
    """Return a box under review."""
    fields = {"score": 0.6, "weight": 0.5, "asked": True} | changes
    return ShownBox(k, category, box, **fields)


def small_sheet(editor: str = "kitti") -> Sheet:
    """Return frame 000001 with a car, a pedestrian and a human label.

    Frame 000002 with a cyclist.
    """
    human = shown("Car", (30.0, -6.0, -0.5, 4.2, 1.7, 1.5, 1.5), 1_000_000, asked=False, human=True)
    return Sheet(
        1,
        "pspsl",
        editor,
        CATEGORIES,
        (
            ShownFrame("000001", (shown("Car", CAR), shown("Pedestrian", WALKER, 1), human)),
            ShownFrame("000002", (shown("Cyclist", CYCLIST),)),
        ),
    )
