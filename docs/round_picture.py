"""A picture of the round: an SVG with a box for each stage and an arrow for what it hands on."""

from html import escape

from pipelines.engine.graph import Graph

_WIDTH, _HEIGHT = 190, 46
_GAP_X, _GAP_Y = 24, 62
_MARGIN = 16
_HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
    'width="{width}" height="{height}" font-family="sans-serif">\n'
    '<rect width="100%" height="100%" fill="#ffffff"/>\n'
    '<defs><marker id="end" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">'
    '<path d="M0,0 L8,4 L0,8 z" fill="#64748b"/></marker></defs>\n'
)
_INPUTS = "data set"


def round_picture(graph: Graph) -> str:
    """Return the SVG: rows from top to bottom, a stage below all stages that it reads from."""
    writers = {table: stage.name for stage in graph.stages for table in stage.writes}
    needs = {
        stage.name: dict.fromkeys(writers.get(table, _INPUTS) for table in stage.reads)
        for stage in graph.stages
    }
    rows: list[list[str]] = [[_INPUTS]]
    row_of = {_INPUTS: 0}
    for stage in graph.stages:
        row = 1 + max(row_of[name] for name in needs[stage.name])
        row_of[stage.name] = row
        rows += [[]] * (row + 1 - len(rows))
        rows[row] = [*rows[row], stage.name]
    widest = max(map(len, rows))
    width = 2 * _MARGIN + widest * _WIDTH + (widest - 1) * _GAP_X + 2 * _WIDTH // 3
    place = {
        name: (
            (width - len(row) * _WIDTH - (len(row) - 1) * _GAP_X) / 2 + i * (_WIDTH + _GAP_X),
            _MARGIN + number * (_HEIGHT + _GAP_Y),
        )
        for number, row in enumerate(rows)
        for i, name in enumerate(row)
    }
    height = 2 * _MARGIN + len(rows) * _HEIGHT + (len(rows) - 1) * _GAP_Y
    parts = [_HEAD.format(width=width, height=height)]
    read = sorted({table for stage in graph.stages for table in stage.reads} - set(writers))
    writes = {_INPUTS: read} | {stage.name: list(stage.writes) for stage in graph.stages}
    for name, sources in needs.items():
        parts += [_arrow(place[one], place[name], row_of[name] - row_of[one]) for one in sources]
    parts += [_box(place[name], name, tables) for name, tables in writes.items()]
    return "".join([*parts, "</svg>\n"])


def _box(place: tuple[float, float], name: str, writes: list[str]) -> str:
    x, y = place
    fill = "#f1f5f9" if name == _INPUTS else "#dbeafe"
    middle = x + _WIDTH / 2
    return (
        f'<rect x="{x:.0f}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}" rx="6" fill="{fill}" '
        'stroke="#64748b"/>\n'
        f'<text x="{middle:.0f}" y="{y + 19}" font-size="15" font-weight="bold" fill="#0f172a" '
        f'text-anchor="middle">{escape(name)}</text>\n'
        f'<text x="{middle:.0f}" y="{y + 37}" font-size="11" fill="#334155" '
        f'text-anchor="middle">{escape(", ".join(_shortened(writes)))}</text>\n'
    )


def _shortened(tables: list[str]) -> list[str]:
    """Return as many tables as fit into a box, and dots where some are left out."""
    for count in range(len(tables), 0, -1):
        shown = [*tables[:count], *(["..."] * (count < len(tables)))]
        if len(", ".join(shown)) <= 32:
            return shown
    return tables[:1]


def _arrow(start: tuple[float, float], end: tuple[float, float], rows: int) -> str:
    """Return an arrow: straight into the next row, else around the boxes between."""
    x, y = start[0] + _WIDTH / 2, start[1] + _HEIGHT
    x2, y2 = end[0] + _WIDTH / 2, end[1]
    if rows == 1:
        path = f"M{x:.0f},{y} L{x2:.0f},{y2}"
    else:
        side = max(x, x2) + _WIDTH * (0.55 + 0.15 * rows)
        path = f"M{x:.0f},{y} C{side:.0f},{y + 40} {side:.0f},{y2 - 40} {x2:.0f},{y2}"
    return f'<path d="{path}" fill="none" stroke="#64748b" marker-end="url(#end)"/>\n'
