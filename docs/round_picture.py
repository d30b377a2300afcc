"""A picture of the round: an SVG with a box for each stage, and arrows for the order of work."""

from html import escape

from pipelines.engine.graph import Graph

_WIDTH, _HEIGHT = 350, 64
_GAP_X, _GAP_Y = 20, 34
_MARGIN = 16
_HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
    'width="{width}" height="{height}" font-family="sans-serif" text-anchor="middle">\n'
    '<rect width="100%" height="100%" fill="#ffffff"/>\n'
    '<defs><marker id="end" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">'
    '<path d="M0,0 L8,4 L0,8 z" fill="#64748b"/></marker></defs>\n'
)
_BOX = (
    '<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="6" fill="#dbeafe" '
    'stroke="#64748b"/>\n'
    '<text x="{middle}" y="{name_y}" font-size="15" font-weight="bold" fill="#0f172a">'
    "{name}</text>\n"
    '<text x="{middle}" y="{reads_y}" font-size="11" fill="#334155">reads {reads}</text>\n'
    '<text x="{middle}" y="{writes_y}" font-size="11" fill="#334155">writes {writes}</text>\n'
)


def round_picture(graph: Graph) -> str:
    """Return the SVG: rows from top to bottom, each stage below all that it depends on.

    An arrow is left out where another path of arrows leads to the same stage.
    """
    before = _dependencies(graph)
    rows: list[list[str]] = []
    row_of: dict[str, int] = {}
    for name, others in before.items():
        row_of[name] = max((row_of[other] + 1 for other in others), default=0)
        rows += [[] for _ in range(row_of[name] + 1 - len(rows))]
        rows[row_of[name]].append(name)
    width = 2 * _MARGIN + _span(max(map(len, rows)))
    place = {
        name: (
            (width - _span(len(row))) // 2 + i * (_WIDTH + _GAP_X),
            _MARGIN + number * (_HEIGHT + _GAP_Y),
        )
        for number, row in enumerate(rows)
        for i, name in enumerate(row)
    }
    height = 2 * _MARGIN + len(rows) * (_HEIGHT + _GAP_Y) - _GAP_Y
    parts = [_HEAD.format(width=width, height=height)]
    for name, others in before.items():
        distant = {one for other in others for one in before[other]}
        parts += [_arrow(place[other], place[name]) for other in sorted(others - distant)]
    for stage in graph.stages:
        x, y = place[stage.name]
        parts.append(
            _BOX.format(
                x=x, y=y, width=_WIDTH, height=_HEIGHT, middle=x + _WIDTH // 2,
                name=escape(stage.name), name_y=y + 21,
                reads=escape(", ".join(stage.reads)), reads_y=y + 39,
                writes=escape(", ".join(stage.writes)), writes_y=y + 54,
            )
        )  # fmt: skip
    return "".join([*parts, "</svg>\n"])


def _dependencies(graph: Graph) -> dict[str, set[str]]:
    """Return for each stage all stages that it depends on, directly or through others."""
    found: dict[str, set[str]] = {}
    for stage in graph.stages:
        direct = {other.name for other in graph.stages if set(other.writes) & set(stage.reads)}
        found[stage.name] = direct.union(*(found[name] for name in direct))
    return found


def _span(boxes: int) -> int:
    """Return the width of some boxes beside each other."""
    return boxes * (_WIDTH + _GAP_X) - _GAP_X


def _arrow(start: tuple[int, int], end: tuple[int, int]) -> str:
    x, y = start[0] + _WIDTH // 2, start[1] + _HEIGHT
    return (
        f'<path d="M{x},{y} L{end[0] + _WIDTH // 2},{end[1]}" stroke="#64748b" '
        'marker-end="url(#end)"/>\n'
    )
