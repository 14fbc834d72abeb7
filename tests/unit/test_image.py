"""Tests `Image` and `RenderedImage`: their planes, missing planes, and when they wait
for a drawing."""

from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest

from v3dg.image import Image, RenderedImage, Stats

COLOR = np.zeros((2, 3, 3), np.float32)
ALPHA = np.ones((2, 3), np.float32)
DEPTH = np.full((2, 3), 5, np.float32)
STATS = Stats(12, 7, 3.0, 0.5, 1.5)


class Drawing:
    """Replaces a drawing of the core, and counts how often a picture waits for it."""

    def __init__(self, *, exceeds_budget=False):
        self.color = COLOR
        self.alpha = ALPHA
        self.depth = None
        self.right = SimpleNamespace(color=COLOR + 1, alpha=ALPHA, depth=DEPTH)
        self.exceeds_budget = exceeds_budget
        self.waits = 0

    def finish(self):
        self.waits += 1
        return self


def test_image_has_the_planes_that_it_is_made_of():
    image = Image(COLOR, ALPHA, DEPTH)
    assert image.color is COLOR
    assert image.alpha is ALPHA
    assert image.depth is DEPTH


def test_depth_that_was_not_drawn_is_an_attribute_error():
    image = Image(COLOR, ALPHA, None)
    assert not hasattr(image, "depth")
    with pytest.raises(AttributeError, match=r"drawn with depth=True, got one without"):
        image.depth  # noqa: B018


def test_a_drawing_is_waited_for_where_a_plane_is_looked_at():
    drawing = Drawing()
    image = RenderedImage(drawing, lambda: STATS)
    assert drawing.waits == 0
    assert image.color is COLOR
    assert image.alpha is ALPHA
    assert drawing.waits == 2


def test_the_right_eye_has_planes_of_its_own():
    drawing = Drawing()
    image = RenderedImage(drawing, lambda: STATS, is_right=True)
    assert image.color is drawing.right.color
    assert image.depth is DEPTH


def test_a_budget_that_is_exceeded_raises_where_the_picture_is_looked_at():
    def finish():
        raise ValueError("budget: expected at least 12 gaussians, got 11")

    image = RenderedImage(Drawing(exceeds_budget=True), finish)
    for name in ("color", "alpha", "depth", "stats"):
        with pytest.raises(ValueError, match="budget: expected at least 12"):
            getattr(image, name)


def test_stats_are_those_of_the_finished_picture():
    image = RenderedImage(Drawing(), lambda: STATS)
    assert image.stats is STATS
    assert STATS.levels == ()
    assert (STATS.missing, STATS.failed, STATS.bytes_in, STATS.memory) == (0, 0, 0, None)


def test_an_image_is_saved_as_it_is_or_transparent(tmp_path):
    color = np.full((4, 6, 3), 0.25, np.float32)
    alpha = np.full((4, 6), 0.5, np.float32)
    color[0] = 0
    alpha[0] = 0
    image = Image(color, alpha, None)
    image.save(tmp_path / "a.png")
    image.save(tmp_path / "b.png", transparent=True)
    opaque = PIL.Image.open(tmp_path / "a.png")
    assert (opaque.mode, opaque.getpixel((1, 1))) == ("RGB", (64, 64, 64))
    straight = PIL.Image.open(tmp_path / "b.png")
    assert straight.getpixel((1, 1)) == (128, 128, 128, 128)
    assert straight.getpixel((1, 0)) == (0, 0, 0, 0)
    color[0] = 1
    with pytest.raises(ValueError, match="drawn on black, got one on another background"):
        image.save(tmp_path / "c.png", transparent=True)
    with pytest.raises(ValueError, match=r"ending in \.png for a transparent picture"):
        image.save(tmp_path / "c.jpg", transparent=True)
    assert not (tmp_path / "c.png").exists()
