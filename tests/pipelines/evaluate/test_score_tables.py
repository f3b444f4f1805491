"""Cells and means of score tables."""

import math

import pytest

from pipelines.evaluate.score_tables import cell, mean, mean_of_all
from pipelines.shared.text_tables import number


def test_a_mean_says_what_failed():
    scores = [{"normal_mae": 4.0}, {}, {"normal_mae": 6.0}]
    found = mean(scores, "normal_mae")
    assert found.cell(3.5) == "5.00 (3.50) [1 of 3 failed]" and found.plain() == 5.0
    nothing = mean(scores[1:2], "normal_mae")
    assert nothing.cell() == "-" and nothing.plain() is None


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(12.345, None, "12.35"), (0.12345, None, "0.123"), (1.0, None, "1.00"), (0.5, 2, "0.50"), (math.nan, None, "-"),
     (None, 3, "-")],
)  # fmt: skip
def test_figures_have_two_decimals_from_one_up_and_three_below(value, digits, text):
    assert number(value, digits) == text


def test_published_figures_stand_in_brackets():
    assert cell(4.0, 3.5, 2) == "4.00 (3.50)"
    assert cell(None, 0.104) == "- (0.104)"
    assert cell("not trained", 4.1) == "not trained (4.10)"
    assert cell("not trained") == "not trained"


def test_a_mean_of_all_needs_every_object():
    assert mean_of_all({"a": 1.0, "b": 3.0}, ["a", "b"]) == 2.0
    assert mean_of_all({"a": 1.0}, ["a", "b"]) is None
