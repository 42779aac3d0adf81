"""Texts of options."""

import dataclasses

import pytest

from colmap_inertial.cli import main
from colmap_inertial.cli.help import Option, _shorten


def test_a_long_text_of_an_option_becomes_its_first_sentence():
    long = "A length in metres. " + "More of it, which few need to know. " * 5
    texts = ("Short. As it is", long, "x" * 200)
    option = Option(
        label="a", text="", field="a", group="", positional=False, required=False, source=object, choices=()
    )
    shortened = [_shorten(dataclasses.replace(option, text=text)).text for text in texts]
    assert shortened == ["Short. As it is", "A length in metres.", "x" * 200 + "."]


@pytest.mark.parametrize("given", [["--mapping.pairing", "exhaustiv"], ["--mapping.pairing=exhaustiv"]])
def test_a_wrong_choice_is_refused_with_the_choices_that_there_are(capsys, given):
    with pytest.raises(SystemExit) as end:
        main(["reconstruct", "capture", "out", *given])
    said = capsys.readouterr().err
    assert end.value.code == 2 and said.startswith("error: --mapping.pairing: 'exhaustiv'")
    assert all(repr(choice) in said for choice in ("auto", "exhaustive", "sequential")) and "None" not in said
