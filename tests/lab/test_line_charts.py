"""Line charts: names at the ends of lines."""

import numpy as np

from lab.shared import line_charts
from pipelines.shared import charts


def test_names_at_the_ends_of_lines_do_not_overlap():
    axes = charts.new_figure(4, 3).add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 10))
    line_charts.label_ends(
        axes, [(str(n), 5.0 + 0.01 * n, "k") for n in range(6)] + [("gone", float("nan"), "k")], gap=0.1
    )
    places = sorted(text.xyann[1] for text in axes.texts)
    assert len(places) == 6 and np.diff(places).min() > 0.099
