"""Examples run, small; what they need beyond the package is optional."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


def load_example(name):
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # where dataclasses look for it
    specification.loader.exec_module(module)
    return module


@pytest.fixture
def film(tmp_path, device):
    """Decoded pictures of a tiny film of falling donuts."""
    av = pytest.importorskip("av")
    example = load_example("falling_donuts")
    path = tmp_path / "donuts.mp4"
    config = example.Config(
        path, donuts=6, gaussians=1000, icings=2, seconds=0.4, size=(96, 64), steps=0, device=device
    )
    example.main(config)
    assert list(path.parent.iterdir()) == [path], "nothing temporary stays"
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == example.FPS
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_donuts_are_seen_and_fall(film):
    assert film.shape == (12, 64, 96, 3)
    background = film[0, 0, 0].astype(int)
    rows = []
    for picture in film:
        seen = np.abs(picture.astype(int) - background).max(axis=-1) > 40
        assert seen.mean() > 0.01
        rows.append(np.argwhere(seen)[:, 0].mean())
    assert rows[-1] > rows[0] + 3, "further down in the picture"
