"""What the page asks is what `sdps infer` can be told, in words that the page has."""

import argparse
import re
from pathlib import Path
from typing import get_args

import pytest

from pipelines.app.pages import photo_questions
from pipelines.app.pages.photo_questions import make_arguments, read_answers, say_plainly
from pipelines.infer import add_arguments
from render.shared.errors import InputError
from sdps.api import LitBy
from sdps.methods.flat_things import Wish
from sdps.photos import Pose

TEMPLATE = Path(photo_questions.__file__).parents[1] / "templates" / "photographs.html.j2"


def test_no_answers_are_the_defaults_of_the_command(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    answers = read_answers({"refine": True})
    made = make_arguments(tmp_path, Pose("a", tmp_path, tmp_path), answers)
    assert vars(made) == vars(parser.parse_args([]))


def test_page_command_and_python_know_the_same_kinds_of_light_and_of_flatness() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    (flag,) = (action for action in parser._actions if action.dest == "lit_by")
    assert flag.choices == photo_questions._CHOICES["lit_by"] == get_args(LitBy)
    assert set(photo_questions._CHOICES["flat"]) == set(get_args(Wish))


def test_answers_become_flags(tmp_path: Path) -> None:
    asked = {
        "focal": "28", "principal": "30,20", "pixel_size": "0.12", "light_distance": "400mm", "intensities": "equal",
        "ambient": "../../etc/off.png", "dark": "none", "flatten": "0.25", "scale": "auto", "lights": True,
        "balls": ["white:auto"], "ball_radius": "12.5",
    }  # fmt: skip
    made = make_arguments(tmp_path, Pose("a", tmp_path, tmp_path / "in"), read_answers(asked))
    assert (made.focal, made.principal, made.pixel_size) == ("28mm", "30,20", 0.12)
    assert (made.light_distance, made.intensities, made.lights) == ("400mm", "equal", "folder")
    assert (made.ambient, made.dark) == (tmp_path / "in" / "off.png", "none")
    assert (made.flatten, made.scale, made.ball, made.refine) == (0.25, "auto", ["white:auto"], False)
    assert made.ball_radius == 12.5
    gone = make_arguments(tmp_path, Pose("a", tmp_path, tmp_path), read_answers(asked | {"balls": []}))
    assert gone.ball_radius is None  # which needs a ball


@pytest.mark.parametrize(
    ("asked", "said"),
    [({"every": "x"}, "Every so many frames: must be a number"), ({"pixel_size": [1]}, "Size of a pixel: must be"),
     ({"ball_radius": "big"}, "Radius of the balls: must be a number"),
     ({"ball_alone": 1e308}, "ball_alone: must be a number"), ({"pixel_size": "inf"}, "Size of a pixel: must be"),
     ({"every": "9" * 5000}, "must be a number"), ({"flatten": "2"}, "flatten: must be one of 0, 0.1")],
)  # fmt: skip
def test_answers_that_are_none_end_in_one_line(asked: dict, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        read_answers(asked)


def test_the_page_has_every_question_under_the_name_that_messages_use() -> None:
    text = TEMPLATE.read_text()
    for label in photo_questions._LABELS.values():
        assert re.search(rf"(?:>|^)\s*{re.escape(label)}", text, re.M | re.I), label
    for name in (*photo_questions._CHOICES, *photo_questions._TEXTS, *photo_questions._NUMBERS):
        assert f'id="{name.replace("_", "-")}"' in text, name


def test_texts_name_questions_in_place_of_flags() -> None:
    said = "reduce it; --scale 0.5 (in Python load(..., scale=0.5)) is enough, or --light-distance far"
    assert say_plainly(said) == (
        'reduce it; "Size of the pictures" 0.5 is enough, or "How far away the lamps stood" far'
    )
    assert say_plainly("left out: a.txt; --images takes what it names") == "left out: a.txt"
    assert say_plainly("p -- q--flat-share") == "p -- q--flat-share"


def test_an_answer_that_a_note_names_is_one_of_the_page() -> None:
    said = say_plainly("look at a place that you know, and use --flat turned if it is inside out.")
    answer = said.split('"')[1]
    assert said.endswith('" if it is inside out.') and f">{answer}</option>" in TEMPLATE.read_text()
