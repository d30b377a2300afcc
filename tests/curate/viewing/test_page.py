"""Pages and their charts: well-formed, self-contained, all text escaped."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from support.toys import toy_calibration

from curate.frames import Frame
from curate.viewing.charts import histogram
from curate.viewing.close_up import CloseUpLabel, draw_close_up
from curate.viewing.page import Figure, Section, render_page

EVIL = "<script>alert('x')</script> & \"q\""


class Reader(HTMLParser):
    """Checks that tags are closed in order, and collects tags and links."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.links = [], [], []

    def handle_starttag(self, tag, attrs):
        """Push the opened tag."""
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in {"src", "href"}]
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        """Do nothing: the tag is closed at once."""
        self.tags.append(tag)

    def handle_endtag(self, tag):
        """Check that the last opened tag is closed first."""
        assert self.open.pop() == tag


def test_a_page_is_well_formed_and_loads_nothing():
    """Hostile text is escaped; the only source is the embedded image."""
    picture = Figure.of_image(np.zeros((8, 8, 3), np.uint8), EVIL)
    chart = histogram("a", np.array([1, 2]), np.array([0, 0.5, 1]), EVIL)
    figures = [picture, Figure.of_chart(chart, EVIL)]
    rows = [(EVIL, 1.23456, None, float("nan"))]
    section = Section(EVIL, EVIL, (EVIL, "b", "c", "d"), rows, figures, [(EVIL, EVIL)])
    reader = Reader()
    text = render_page(EVIL, EVIL, [section])
    reader.feed(text)
    assert reader.open == []
    assert "script" not in reader.tags
    assert {"table", "img", "svg", "path"} <= set(reader.tags)
    assert [link[:23] for link in reader.links] == ["data:image/jpeg;base64,"]
    assert not re.search(r"https?://|url\(|@import", text)
    assert "<td>1.235</td><td></td><td></td>" in text
    assert "prefers-color-scheme: dark" in text


def test_numbers_are_formatted():
    """Thousands separators, highlighted sums, left-aligned text."""
    section = Section("t", columns=("a", "b"), rows=[("Car", 1234567), ("all", 98765.4)])
    text = render_page("t", "", [section])
    assert '<td class="text">Car</td><td>1,234,567</td>' in text
    assert '<tr class="all"><td class="text">all</td><td>98,765</td>' in text


@pytest.mark.parametrize("place", [(12.0, 1.0), (12.0, 11.9), (-5.0, 0.0)])
def test_a_close_up_shows_a_label_anywhere(place):
    """Also at the image border and outside; the earlier box is drawn too."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-20, -20, -2, 0], [40, 20, 1, 1], (3000, 4)).astype(np.float32)
    image = rng.integers(0, 255, (40, 120, 3), dtype=np.uint8)
    frame = Frame("000000", points, toy_calibration(), (120, 40), image)
    box = np.array([*place, -0.5, 4, 2, 1.5, 0.3])
    alone = draw_close_up(frame, CloseUpLabel(box, 0.8))
    both = draw_close_up(frame, CloseUpLabel(box, 0.8, box + np.array([1, 1, 0, 0, 0, 0, 0])))
    assert alone.shape == (260, 650, 3)
    assert (alone != both)[:, 390:].any()
