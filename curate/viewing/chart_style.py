"""The common style of all charts, and their output as SVG, PNG or PDF.

Charts are matplotlib figures without pyplot. The same data gives the same bytes: files contain no
dates, and ids are fixed. An inline SVG uses the colours of the HTML page, to follow its light or
dark scheme.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from curate.errors import ConfigError
from curate.files.atomic import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ImageFormat = Literal["svg", "png", "pdf"]

INK, FAINT, RULE, GROUND = "#1b2129", "#5b6675", "#d5dae2", "#ffffff"
BAR, MARK = "#2a7fb8", "#c2410c"
_PAGE_COLOURS = {
    INK: "--text", FAINT: "--faint", RULE: "--line", GROUND: "--panel", BAR: "--bar",
    MARK: "--mark",
}  # fmt: skip

_DPI = 160
_RC: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.edgecolor": FAINT,
    "axes.labelcolor": FAINT,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "grid.color": RULE,
    "grid.linewidth": 0.7,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "text.color": INK,
    "legend.frameon": False,
    "figure.facecolor": GROUND,
    "figure.constrained_layout.use": True,
    "pdf.fonttype": 42,  # TrueType: text stays editable in PDF editors
}


@contextmanager
def chart_style(**settings: Any) -> Iterator[None]:
    """Apply the style, then `settings`, to matplotlib within a `with` block."""
    from matplotlib import rc_context

    style: Any = {**_RC, **settings}
    with rc_context(style):
        yield


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure with its size in inches; call it within `chart_style`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def check_format(name: str) -> ImageFormat:
    """Return the format with this name.

    Raises:
        ConfigError: if the name is not svg, png or pdf.
    """
    for image_format in get_args(ImageFormat):
        if name == image_format:
            return image_format  # type: ignore[no-any-return]
    raise ConfigError(f"--format {name}: use {', '.join(get_args(ImageFormat))}")


@dataclass(frozen=True)
class Chart:
    """A finished chart.

    Attributes:
        name: stem of the file name; unique within a page.
        description: text alternative for screen readers.
        figure: the matplotlib figure.
    """

    name: str
    description: str
    figure: "Figure"

    def content(self, kind: ImageFormat) -> bytes:
        """Return the content of an image file."""
        return figure_content(self.figure, kind, self.name)

    def save(self, path: Path) -> None:
        """Write an image file atomically; the suffix of `path` is the format."""
        replace_file(path, self.content(check_format(path.suffix[1:])))

    def inline(self) -> str:
        """Return an <svg> element that uses the colours of the page."""
        content = figure_content(self.figure, "svg", self.name, _DPI, **{"svg.fonttype": "none"})
        text = content.decode("utf-8")
        text = text[text.index("<svg") :].rstrip()
        text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        width, height = re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', text)[0]
        text = re.sub(
            r"<svg[^>]*>",
            f'<svg viewBox="0 0 {width} {height}" role="img" '
            f'aria-label="{escape(self.description)}">',
            text,
            count=1,
        )
        text = re.sub(r"<defs>\s*<style.*?</defs>", "", text, flags=re.DOTALL)
        # A page may contain several charts, and ids must be unique: parts get classes instead.
        text = re.sub(r'<g id="([a-z]+)[^"]*"', r'<g class="\1"', text)
        text = _without_references(text).replace("'DejaVu Sans'", "system-ui")
        for colour, variable in _PAGE_COLOURS.items():
            text = text.replace(colour, f"var({variable})")
        return text


def figure_content(
    figure: "Figure", kind: ImageFormat, salt: str, dpi: int = _DPI, **settings: Any
) -> bytes:
    """Return a figure as the content of an image file; equal figures give equal bytes.

    Args:
        figure: a matplotlib figure.
        kind: format of the file.
        salt: matplotlib derives the ids in an SVG from it.
        dpi: resolution of a PNG, and of the parts that are not vectors.
        settings: matplotlib settings in addition to the style.
    """
    dates = {"svg": {"Date": None}, "png": {"Software": None}, "pdf": {"CreationDate": None}}
    buffer = BytesIO()
    with chart_style(**settings, **{"svg.hashsalt": salt}):
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=dates[kind])
    return buffer.getvalue()


def _without_references(svg: str) -> str:
    """Replace each <use> in an SVG by the path that it refers to."""
    shapes = dict(re.findall(r'<path id="(\w+)" d="([^"]*)"', svg))
    svg = re.sub(r"<defs>.*?</defs>", "", svg, flags=re.DOTALL)
    return re.sub(
        r'<use xlink:href="#(\w+)" x="([-\d.]+)" y="([-\d.]+)"',
        lambda use: f'<path d="{shapes[use[1]]}" transform="translate({use[2]} {use[3]})"',
        svg,
    )


def unclip(axes: "Axes") -> None:
    """Turn off clipping at the edge of the axes, which would cut a dot on the edge in half."""
    for artist in axes.findobj():
        artist.set_clip_on(False)
