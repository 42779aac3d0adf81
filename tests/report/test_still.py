"""Still pictures of figures."""

from colmap_inertial.report import still


def test_a_colour_between_two_lies_at_its_share_of_the_way():
    scale = [[0.0, "#000000"], [0.5, "#804020"], [1.0, "#ffffff"]]
    colours = [still._mix(scale, share) for share in (-1.0, 0.25, 0.75, 2.0)]
    assert colours == ["#000000", "#402010", "#c0a090", "#ffffff"]
