"""Texts of options."""

from colmap_inertial.cli.help import Option, _shorten


def test_a_long_text_of_an_option_becomes_its_first_sentence():
    long = "A length in metres. " + "More of it, which few need to know. " * 5
    texts = ("Short. As it is", long, "x" * 200)
    options = [
        Option(
            names=("a",),
            group="",
            field="a",
            value="",
            text=text,
            default="",
            positional=False,
            required=False,
            source=object,
        )
        for text in texts
    ]
    assert [option.text for option in _shorten(options)] == ["Short. As it is", "A length in metres.", "x" * 200 + "."]
