"""How tables are written: encodings, delimiters, decimal signs, preambles, headers of several rows."""

from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.io.dialect import decode, join_header, plain_text
from colmap_inertial.io.tables import parse_bytes, parse_table

NAMES = ("t [ms]", "gx [deg/s]", "gy [deg/s]", "note")
VALUES = np.array([[10.0 * i, 0.5 * i - 3, 1e-3 * i * i] for i in range(40)])


def rows(delimiter, decimal=".", note="free hand"):
    return [delimiter.join([*(f"{v:.4f}".replace(".", decimal) for v in row), note]) for row in VALUES]


def text_of(delimiter, decimal=".", before=(), names=NAMES, after=(), note="free hand"):
    return "\n".join([*before, delimiter.join(names), *after, *rows(delimiter, decimal, note), ""])


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("before", [(), ("Logger 3", 'Key,"a, b"', "Serial: 4,5", ""), ("# made by hand",)])
def test_delimiter_decimal_sign_and_preamble_are_found(delimiter, decimal, before):
    if delimiter == decimal:
        return
    table = parse_bytes(Path("a.csv"), text_of(delimiter, decimal, before).encode())
    assert table.header == NAMES and table.delimiter == delimiter
    np.testing.assert_allclose(table.numbers([0, 1, 2]), VALUES, atol=1e-4)
    assert table.line_numbers[0] == len(before) + 2
    assert ("decimal commas" in table.found) == (decimal == ",")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252", "gb18030"])
def test_encodings_are_found(encoding):
    names = ("t [ms]", "gx [°/s]", "gy [°/s]", "note")
    table = parse_bytes(Path("a.csv"), text_of(";", names=names).encode(encoding))
    assert table.header == names
    np.testing.assert_allclose(table.numbers([0, 1, 2]), VALUES, atol=1e-4)


def test_a_damaged_byte_does_not_change_the_encoding():
    data = ("t,x µ\n" + "1,2\n" * 30).encode()
    assert decode(data.replace(b"1,2\n", b"1,\xff\n", 1)) == (data.decode().replace("1,2", "1,�", 1), "utf-8")
    late = b"t,x\n" + b"1,2\n" * 40_000 + b"1,\xb0\n"
    assert decode(late)[1] == "utf-8"


def test_rows_of_a_header_are_joined():
    assert join_header([("t", "ax"), ("CAL", "CAL"), ("ms", "m/(s^2)")]) == ("t [ms]", "ax [m/(s^2)]")
    assert join_header([("time", "acc", "", "gyro"), ("", "x", "y", "x"), ("s", "g", "g", "°/s")]) == (
        "time [s]",
        "acc x [g]",
        "acc y [g]",
        "gyro x [°/s]",
    )


def test_units_may_stand_in_a_second_row_under_a_stated_delimiter():
    names = ("t", "gx", "gy", "note")
    text = "sep=;\n" + text_of(";", names=names, after=("CAL;CAL;CAL;", "ms;deg/s;deg/s;no units"))
    table = parse_bytes(Path("a.csv"), text.encode())
    assert table.header == ("t [ms]", "gx [deg/s]", "gy [deg/s]", "note") and len(table) == len(VALUES)


def test_delimiters_in_quotes_and_at_the_ends_of_lines():
    quoted = text_of(",", note='"one, two"')
    assert parse_bytes(Path("a.csv"), quoted.encode()).text(3)[0] == "one  two"
    ended = "".join(f"{line},\n" for line in text_of(",").splitlines())
    assert parse_bytes(Path("a.csv"), ended.encode()).width == 4
    only_rows = "".join(f"{line},\n" if i else f"{line}\n" for i, line in enumerate(text_of(",").splitlines()))
    assert parse_bytes(Path("a.csv"), only_rows.encode()).header == NAMES


def test_a_header_that_comes_again_is_passed_over():
    text = text_of(",") + text_of(",")
    assert len(parse_bytes(Path("a.csv"), b"Begin\n" + text.encode())) == 2 * len(VALUES)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "\n\n",
        "t,x\n",
        "t,x\n1,2,3\n4,5,6\n",
        "1,2\n3,4\n",
        "# t x\n1 2\n3 4\n",
        "t;x;y\n1;2;3\n\n4;5;6\n# in between\n7;8;9\n1;2",
        "a,b,c\n1,2,x\n2,3,y\n",
        "name,t_s\na.png,1\nb.png,2\n",
        "t\n1\n2\n",
        "1,2\n4,5\n3\n",
    ],
)
def test_what_is_plain_or_no_table_stays_as_it_is(text):
    assert plain_text(text).text == text
    try:
        expected = parse_table(Path("a.csv"), text)
    except Exception as error:
        with pytest.raises(type(error)) as caught:
            parse_bytes(Path("a.csv"), text.encode())
        assert str(caught.value) == str(error)
    else:
        assert parse_bytes(Path("a.csv"), text.encode()).lines == expected.lines
