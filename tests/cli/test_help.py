"""Texts of options."""

import dataclasses

from colmap_inertial.cli.help import Option, _shorten


def test_a_long_text_of_an_option_becomes_its_first_sentence():
    long = "A length in metres. " + "More of it, which few need to know. " * 5
    texts = ("Short. As it is", long, "x" * 200)
    option = Option(label="a", text="", field="a", group="", positional=False, required=False, source=object)
    shortened = [_shorten(dataclasses.replace(option, text=text)).text for text in texts]
    assert shortened == ["Short. As it is", "A length in metres.", "x" * 200 + "."]
