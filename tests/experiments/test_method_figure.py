"""The picture of the method is what its script draws, and small."""

from pathlib import Path

import matplotlib.image
import numpy as np

from experiments.report import method_figure

COMMITTED = Path(__file__).parents[2] / "results" / "method.svg"


def test_the_figure_is_drawn_equal_every_time_and_small(tmp_path):
    for name in ("one.svg", "two.svg"):
        method_figure.main([str(tmp_path / name)])
    drawn = (tmp_path / "one.svg").read_bytes()
    assert drawn == (tmp_path / "two.svg").read_bytes()
    assert len(drawn) < 100_000 and COMMITTED.stat().st_size < 100_000


def test_the_figure_shows_five_members_and_four_tasks(tmp_path):
    figure = method_figure.draw()
    texts = {text.get_text() for text in figure.axes[0].texts}
    assert {"run forward", "run backward", "front flip", "back flip"} <= texts
    method_figure.main([str(tmp_path / "figure.png")])
    pixels = matplotlib.image.imread(tmp_path / "figure.png")[..., :3].reshape(-1, 3)
    for color in ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#CC79A7"):
        wanted = np.array([int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        assert (abs(pixels - wanted) < 0.01).all(axis=-1).sum() > 100
